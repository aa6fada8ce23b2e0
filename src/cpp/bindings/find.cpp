#include "reconstruction/find/find.hpp"

#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "bindings/inputs.hpp"
#include "reconstruction/find/bit_counts.hpp"
#include "reconstruction/find/compete.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

py::dict run(const Detector& detector, const Array<std::int64_t>& event_offsets, const py::dict& hit_columns,
             const FindSettings& settings, const py::dict& pair_table) {
  const auto offsets = hit_offsets_of(event_offsets);
  const HitColumns columns(detector, hit_columns, static_cast<py::ssize_t>(offsets.back()));
  PairScores pairs;
  if (!pair_table.empty()) {
    Inputs in(pair_table, "score");
    pairs = PairScores(in.get<std::int64_t>("x"), in.get<std::int64_t>("v"), in.get<double>("score"));
  }
  FindOutput found;
  {
    py::gil_scoped_release release;
    std::vector<Hit> hits;
    columns.take(0, static_cast<std::size_t>(offsets.back()), hits);
    found = find_tracks(detector, {offsets, hits, std::move(pairs)}, settings);
  }
  py::dict out;
  out["event"] = to_numpy(std::move(found.event));
  out["offsets"] = to_numpy(std::move(found.offsets));
  out["hits"] = to_numpy(std::move(found.hits));
  out["score"] = to_numpy(std::move(found.score));
  out["chi2"] = to_numpy(std::move(found.chi2));
  out["holes"] = to_numpy(std::move(found.holes));
  out["seeds"] = to_numpy(std::move(found.seeds));
  return out;
}

// Counts of 192 counters after ranges of them, from `first` to `last`, were added; the largest and those that
// have it.
py::tuple count_ranges(const Array<std::int32_t>& firsts, const Array<std::int32_t>& lasts) {
  constexpr std::size_t words = 3;
  const auto first = column(firsts, "first"), last = column(lasts, "last", firsts.size());
  BitCounts<words> counts;
  for (std::size_t i = 0; i < first.size(); ++i) {
    if (first[i] < 0 || last[i] < first[i] || last[i] >= static_cast<std::int32_t>(64 * words)) {
      throw std::invalid_argument("first, last: expected ranges within 0 and 191");
    }
    BitCounts<words>::Bits bits{};
    set_bits(bits, static_cast<unsigned>(first[i]), static_cast<unsigned>(last[i]));
    counts.add(bits);
  }
  const auto [most, which] = counts.most();
  std::vector<std::uint8_t> found, largest;
  for (std::size_t i = 0; i < 64 * words; ++i) {
    found.push_back(counts.at(i));
    largest.push_back(static_cast<std::uint8_t>(which[i / 64] >> i % 64 & 1));
  }
  return py::make_tuple(to_numpy(std::move(found)), most, to_numpy(std::move(largest)));
}

// For tests: tracks with nothing but hits compete.
py::dict settle(const py::dict& track_columns, const py::dict& entry_columns, const py::dict& hit_columns,
                double min_score) {
  Inputs of_track(track_columns, "score"), of_entry(entry_columns, "hit"), of_hit(hit_columns, "wire");
  const auto score = of_track.get<double>("score");
  const auto count = of_track.get<std::int64_t>("hits");
  const auto hit = of_entry.get<std::int64_t>("hit");
  const auto gain = of_entry.get<double>("gain");
  const auto wire = of_hit.get<bool>("wire"), along = of_hit.get<bool>("along");
  std::vector<HitKind> kinds;
  for (std::size_t i = 0; i < wire.size(); ++i) kinds.push_back({wire[i], along[i]});
  std::vector<FoundTrack> tracks(score.size());
  std::size_t entry = 0;
  for (std::size_t i = 0; i < tracks.size(); ++i) {
    tracks[i].score = score[i];
    tracks[i].holes = static_cast<int>(i);  // the competition does not read it
    for (std::int64_t k = 0; k < count[i]; ++k, ++entry) {
      if (entry >= hit.size() || hit[entry] < 0 || static_cast<std::size_t>(hit[entry]) >= kinds.size())
        throw py::value_error("hit: expected the number of a hit for each hit of a track");
      tracks[i].hits.push_back(static_cast<std::int32_t>(hit[entry]));
      tracks[i].gains.push_back(gain[entry]);
      tracks[i].wires += kinds[static_cast<std::size_t>(hit[entry])].wire ? 1 : 0;
    }
  }
  Competition().settle(tracks, kinds, min_score);
  std::vector<std::int64_t> kept, left, hits;
  for (const FoundTrack& track : tracks) {
    kept.push_back(track.holes);
    left.push_back(static_cast<std::int64_t>(track.hits.size()));
    hits.insert(hits.end(), track.hits.begin(), track.hits.end());
  }
  py::dict out;
  out["track"] = to_numpy(std::move(kept));
  out["hits"] = to_numpy(std::move(left));
  out["hit"] = to_numpy(std::move(hits));
  return out;
}

}  // namespace

void bind_find(py::module_& module) {
  py::class_<FindSettings>(module, "FindSettings",
                           "Settings of the finder; the values live in cgemit.find.settings.FindSettings.")
      .def(py::init([](bool segments, bool chamber, bool wires_first, double mass, double efficiency,
                       double gate, int branches, int passes, int holes_in_row, double max_d, double max_z,
                       double min_pt, int least_axial, double min_score, int max_seeds, bool annealing,
                       double least_width, double delta_strips) {
             return FindSettings{segments,    chamber,   wires_first,  mass,      efficiency,  gate,
                                 branches,    passes,    holes_in_row, max_d,     max_z,       min_pt,
                                 least_axial, min_score, max_seeds,    annealing, least_width, delta_strips};
           }),
           py::kw_only(), py::arg("segments"), py::arg("chamber"), py::arg("wires_first"), py::arg("mass"),
           py::arg("efficiency"), py::arg("gate"), py::arg("branches"), py::arg("passes"),
           py::arg("holes_in_row"), py::arg("max_d"), py::arg("max_z"), py::arg("min_pt"),
           py::arg("least_axial"), py::arg("min_score"), py::arg("max_seeds"), py::arg("annealing"),
           py::arg("least_width"), py::arg("delta_strips"));
  module.def(
      "find_tracks", &run, py::arg("detector"), py::kw_only(), py::arg("event_offsets"), py::arg("hits"),
      py::arg("settings"), py::arg("pairs") = py::dict(),
      "Tracks of each event: event, offsets of their hits, numbers of the hits, score; and how many seeds "
      "each event had.");
  testing(module).def("count_ranges", &count_ranges, py::arg("first"), py::arg("last"),
                      "Counts of 192 counters of ranges, the largest count, and where it is.");
  testing(module).def(
      "settle_tracks", &settle, py::kw_only(), py::arg("tracks"), py::arg("entries"), py::arg("hits"),
      py::arg("min_score"),
      "Competition of tracks (score, number of hits) for hits (on a wire, along the beam); entries are "
      "the hits of the tracks, one after the other, and their gains. Returns the numbers of the tracks "
      "that remain, the best first, and their hits.");
}

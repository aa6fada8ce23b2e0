#include <pybind11/pybind11.h>

#include <cmath>
#include <limits>
#include <optional>

#include "bindings/hits.hpp"
#include "bindings/interrupt.hpp"
#include "bindings/settings.hpp"
#include "calibration/sums.hpp"
#include "common/problems.hpp"
#include "detector/start_radius.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

constexpr int most_columns = 3000;      // of a dense matrix of normal equations
constexpr int most_single = 1'000'000;  // of one in blocks

using Numbers = Array<std::int32_t>;

// A flat list of `size` numbers of columns: -1, or below the number of columns.
std::vector<int> numbers_of(const Numbers& given, const char* name, std::size_t size, int columns) {
  if (given.size() != static_cast<py::ssize_t>(size))
    throw std::invalid_argument(std::string("columns: ") + name + ": expected " + std::to_string(size) +
                                " numbers");
  std::vector<int> numbers(given.data(), given.data() + size);
  for (const int number : numbers)
    if (number < -1 || number >= columns)
      throw std::invalid_argument(std::string("columns: ") + name + ": no such column");
  return numbers;
}

std::vector<RigidColumns> rigid(const Numbers& given, const char* name, std::size_t parts, int columns) {
  const std::vector<int> numbers = numbers_of(given, name, 6 * parts, columns);
  std::vector<RigidColumns> found(parts);
  for (std::size_t i = 0; i < numbers.size(); ++i) found[i / 6][i % 6] = numbers[i];
  return found;
}

ColumnMap column_map(const Detector& detector, const py::dict& given) {
  Settings in("columns", given);
  ColumnMap map;
  map.columns = in["columns"];
  map.drift_step = in["drift_step"];
  const Numbers of_layers = in["layers"], of_sheets = in["sheets"], of_chamber = in["chamber"],
                of_wires = in["wires"], of_east = in["east"], of_west = in["west"],
                of_lorentz = in["lorentz"], of_z_scale = in["z_scale"], of_field = in["field"],
                of_drift = in["drift"];
  const Array<double> shift = in["chamber_shift"], turn = in["chamber_turn"], changes = in["drift_change"];
  const std::vector<Numbers> of_single = in["single"];
  in.check();
  const int most = of_single.empty() ? most_columns : most_single;
  if (map.columns < 0 || map.columns > most)
    throw std::invalid_argument("columns: expected 0 to " + std::to_string(most) + " constants");
  const std::size_t layers = detector.layers.size(), wires = detector.wires.size();
  map.layers = rigid(of_layers, "layers", layers, map.columns);
  const std::vector<RigidColumns> sheets = rigid(of_sheets, "sheets", most_sheets * layers, map.columns);
  map.sheets.resize(layers);
  for (std::size_t i = 0; i < sheets.size(); ++i) map.sheets[i / most_sheets][i % most_sheets] = sheets[i];
  map.chamber = rigid(of_chamber, "chamber", 1, map.columns)[0];
  std::ranges::copy(column(shift, "chamber_shift", 3), map.chamber_shift.begin());
  std::ranges::copy(column(turn, "chamber_turn", 9), map.chamber_turn.begin());
  map.wires = rigid(of_wires, "wires", wires, map.columns);
  map.east = rigid(of_east, "east", wires, map.columns);
  map.west = rigid(of_west, "west", wires, map.columns);
  map.lorentz = numbers_of(of_lorentz, "lorentz", layers, map.columns);
  map.z_scale = numbers_of(of_z_scale, "z_scale", layers, map.columns);
  map.field = numbers_of(of_field, "field", 1, map.columns)[0];
  if (!of_single.empty()) {
    if (of_single.size() != wires)
      throw std::invalid_argument("columns: single: expected an array for each wire layer");
    map.single.resize(wires);
    for (std::size_t i = 0; i < wires; ++i) {
      if (of_single[i].size() == 0) continue;
      const auto cells = static_cast<std::size_t>(detector.wires[i].cells);
      const std::vector<int> numbers = numbers_of(of_single[i], "single", 4 * cells, map.columns);
      map.single[i].resize(cells);
      for (std::size_t k = 0; k < numbers.size(); ++k) map.single[i][k / 4][k % 4] = numbers[k];
    }
  }
  // Changes of drift distances: (wire layers, constants, distances).
  if (changes.ndim() != 3 || changes.shape(0) != static_cast<py::ssize_t>(wires) ||
      (changes.shape(1) > 0 && changes.shape(2) == 0))
    throw std::invalid_argument("columns: drift_change: expected (wire layers, constants, distances)");
  const auto constants = static_cast<std::size_t>(changes.shape(1)),
             steps = static_cast<std::size_t>(changes.shape(2));
  const std::vector<int> drift = numbers_of(of_drift, "drift", wires * constants, map.columns);
  map.drift.resize(wires);
  for (std::size_t i = 0; i < drift.size(); ++i) {
    if (drift[i] < 0) continue;
    const double* from = changes.data() + i * steps;
    map.drift[i / constants].push_back({drift[i], std::vector<double>(from, from + steps)});
  }
  if (!(map.drift_step > 0 && map.drift_step < HUGE_VAL))
    throw std::invalid_argument("columns: drift_step: expected a length above 0");
  return map;
}

py::dict run_sums(const Detector& detector, const py::dict& map_values,
                  const Array<std::int64_t>& hit_offsets, const py::dict& hit_columns,
                  const Array<double>& reference_array, const Array<double>& kinks_array,
                  const Array<double>& mass_array, const Array<double>& charge_array,
                  const Array<double>& matter_p_array, const Array<double>& start_radius,
                  const std::array<double, 5>& prior_sigma, bool bias, bool scattering, bool innovations,
                  const std::vector<std::int32_t>& blocks, bool scalar) {
  const ColumnMap map = column_map(detector, map_values);
  const bool single = !map.single.empty();
  if (single && (bias || innovations))
    throw std::invalid_argument("sums: expected neither bias nor innovations of single wires");
  if (single && (blocks.size() < 2 || blocks.front() != 0 || blocks.back() != map.columns ||
                 !std::ranges::is_sorted(blocks)))
    throw std::invalid_argument("sums: blocks: expected rising numbers from 0 to that of the columns");
  const auto offsets = hit_offsets_of(hit_offsets);
  const std::size_t n = offsets.size() - 1;
  const auto tracks = static_cast<py::ssize_t>(n);
  const auto n_hits = static_cast<py::ssize_t>(offsets.back());
  const auto reference = matrix(reference_array, "reference", tracks, 5);
  const std::size_t angles = 2 * detector.slabs.size();
  const auto kinks = matrix(kinks_array, "kinks", tracks, static_cast<py::ssize_t>(angles));
  const auto mass = column(mass_array, "mass", tracks), matter_p = column(matter_p_array, "matter_p", tracks);
  const std::vector<double> charge = charges(charge_array, tracks);
  const StartRadii begins(detector, n, start_radii(start_radius, tracks));
  std::vector<Perigee> helices;
  Problems problems;
  for (std::size_t i = 0; i < n; ++i) {
    const double* r = &reference[5 * i];
    helices.push_back({r[0], r[1], r[2], r[3], r[4]});
    bool finite =
        std::isfinite(mass[i]) && mass[i] > 0 && matter_p[i] >= 0 && matter_p[i] < HUGE_VAL && r[2] != 0;
    for (std::size_t k = 0; k < 5; ++k) finite = finite && std::isfinite(r[k]);
    for (std::size_t k = 0; k < angles; ++k) finite = finite && std::isfinite(kinks[angles * i + k]);
    if (!finite)
      problems.add("track " + std::to_string(i) +
                   ": expected finite reference, kinks and momentum, kappa other than 0, and a mass above 0");
  }
  problems.raise("sums");
  for (const double sigma : prior_sigma)
    if (!(sigma > 0 && sigma < HUGE_VAL))
      throw std::invalid_argument("prior_sigma: expected numbers above 0");
  const std::vector<UsedHit> used = used_hits(hit_columns, n_hits);
  std::vector<Hit> hits;
  HitColumns(detector, hit_columns, n_hits).take(0, static_cast<std::size_t>(n_hits), hits);
  const auto columns = single ? 0 : static_cast<std::size_t>(map.columns);
  std::optional<WireSums> wire_sums;
  if (single) wire_sums.emplace(blocks);
  std::vector<double> normal(columns * columns), right(columns), measured(columns),
      biases(bias ? n * columns * 5 : 0);
  std::vector<SummedTrack> rows(n);
  InnovationRows innovation_rows;
  const auto sums = scalar ? scalar_kernels().alignment_sums : kernels().alignment_sums;
  {
    py::gil_scoped_release release;
    for (std::size_t begin = 0, count = 0; begin < n && !interrupted(); begin += count) {
      count = begins.alike(begin, n);
      const auto first = static_cast<std::size_t>(offsets[begin]),
                 of_tracks = static_cast<std::size_t>(offsets[begin + count]) - first;
      const FittedTracks input{.offsets = offsets.subspan(begin, count + 1),
                               .hits = std::span<const Hit>(hits).subspan(first, of_tracks),
                               .used = std::span<const UsedHit>(used).subspan(first, of_tracks),
                               .reference = std::span<const Perigee>(helices).subspan(begin, count),
                               .kinks = kinks.subspan(angles * begin, angles * count),
                               .mass = mass.subspan(begin, count),
                               .charge = std::span<const double>(charge).subspan(begin, count),
                               .matter_p = matter_p.subspan(begin, count),
                               .prior_sigma = prior_sigma,
                               .scattering = scattering,
                               .interrupted = interrupted};
      sums(begins.of(begin), input, map,
           {.normal = normal.data(),
            .right = right.data(),
            .measured = measured.data(),
            .rows = rows.data() + begin,
            .bias = bias ? biases.data() + begin * columns * 5 : nullptr,
            .innovations = innovations ? &innovation_rows : nullptr,
            .wires = wire_sums ? &*wire_sums : nullptr,
            .first_track = static_cast<std::int64_t>(begin)});
    }
  }
  throw_if_interrupted();
  Columns<SummedTrack> of_track;
  of_track.append(rows);
  py::dict out = to_dict(std::move(of_track));
  if (wire_sums) {
    BlockedMatrix& found = wire_sums->normal;
    py::dict of_blocks;
    for (std::size_t row = 0; row < found.count(); ++row)
      for (std::size_t other = 0; other <= row; ++other) {
        std::vector<double>& entries = found.block(row, other);
        if (!entries.empty())
          of_blocks[py::make_tuple(row, other)] = to_numpy(
              std::move(entries),
              {static_cast<py::ssize_t>(found.size(row)), static_cast<py::ssize_t>(found.size(other))});
      }
    out["blocks"] = of_blocks;
    out["right"] = to_numpy(std::move(wire_sums->right));
    out["measured"] = to_numpy(std::move(wire_sums->measured));
    out["column_hits"] = to_numpy(std::move(wire_sums->hits));
    return out;
  }
  const auto width = static_cast<py::ssize_t>(columns);
  out["normal"] = to_numpy(std::move(normal), {width, width});
  out["right"] = to_numpy(std::move(right));
  out["measured"] = to_numpy(std::move(measured));
  if (bias) out["bias"] = to_numpy(std::move(biases), {tracks, width, 5});
  if (innovations) {
    py::dict of_rows;
    of_rows["track"] = to_numpy(std::move(innovation_rows.track));
    of_rows["residual"] = to_numpy(std::move(innovation_rows.residual));
    of_rows["variance"] = to_numpy(std::move(innovation_rows.variance));
    of_rows["ends"] = to_numpy(std::move(innovation_rows.ends));
    of_rows["column"] = to_numpy(std::move(innovation_rows.column));
    of_rows["derivative"] = to_numpy(std::move(innovation_rows.derivative));
    out["innovations"] = of_rows;
  }
  return out;
}

}  // namespace

void bind_calibration(py::module_& module) {
  module.def(
      "sums", &run_sums, py::arg("detector"), py::kw_only(), py::arg("columns"), py::arg("hit_offsets"),
      py::arg("hits"), py::arg("reference"), py::arg("kinks"), py::arg("mass"), py::arg("charge"),
      py::arg("matter_p"), py::arg("start_radius"), py::arg("prior_sigma"), py::arg("bias") = false,
      py::arg("scattering") = true, py::arg("innovations") = false,
      py::arg("blocks") = std::vector<std::int32_t>(), py::arg("scalar") = false,
      "Sums of the normal equations of constants of the detector over tracks, each about the reference of "
      "its fit; the helix, covariance and chi-square of every track with this prior; with `bias` the "
      "derivatives of each helix by the constants; with `innovations` the independent rows that the sums are "
      "of. Of single wires the matrix comes in `blocks` of columns, by their first ones.");
}

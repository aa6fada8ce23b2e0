// Single steps of the core that only tests ask for: the sub-module `_testing`.
#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <tuple>

#include "bindings/hits.hpp"
#include "bindings/matter.hpp"
#include "common/angles.hpp"
#include "common/rng.hpp"
#include "kalman/builder.hpp"
#include "kalman/field_reference.hpp"
#include "kalman/tracer.hpp"
#include "kalman/trajectory.hpp"
#include "kernels/kernels.hpp"
#include "matter/electrons.hpp"
#include "matter/foil.hpp"
#include "matter/ionization.hpp"
#include "matter/loss.hpp"
#include "motion/helix.hpp"
#include "motion/wire.hpp"
#include "readout/shaper.hpp"
#include "reconstruction/cluster/charge_time.hpp"
#include "reconstruction/find/bit_counts.hpp"
#include "reconstruction/find/compete.hpp"
#include "reconstruction/fit/seed.hpp"
#include "simulation/digitize/analog_batch.hpp"
#include "simulation/digitize/avalanche.hpp"
#include "simulation/digitize/projection.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

constexpr py::ssize_t point_width = 7;  // x y z ux uy tanl w

HelixPoint point_of(const double* row) { return {row[0], row[1], row[2], row[3], row[4], row[5], row[6]}; }

void store(const HelixPoint& p, std::vector<double>& out) {
  for (const double value : {p.x, p.y, p.z, p.ux, p.uy, p.tanl, p.w}) out.push_back(value);
}

py::tuple to_cylinder(const Array<double>& points, double radius, bool outward) {
  const py::ssize_t n = points.ndim() == 2 ? points.shape(0) : 0;
  const auto rows = matrix(points, "points", n, point_width);
  std::vector<double> moved, arcs;
  std::vector<std::uint8_t> reached;
  for (py::ssize_t i = 0; i < n; ++i) {
    HelixPoint point = point_of(rows.data() + point_width * i);
    double arc = 0;
    reached.push_back(step_to_cylinder(point, radius, arc, outward));
    arcs.push_back(arc);
    store(point, moved);
  }
  return py::make_tuple(to_numpy(std::move(moved), {n, point_width}), to_numpy(std::move(arcs)),
                        to_numpy(std::move(reached)));
}

py::tuple move_along(const Array<double>& points, const Array<double>& arcs) {
  const py::ssize_t n = points.ndim() == 2 ? points.shape(0) : 0;
  const auto rows = matrix(points, "points", n, point_width);
  const auto steps = column(arcs, "arcs", n);
  std::vector<double> moved, apex;
  for (py::ssize_t i = 0; i < n; ++i) {
    HelixPoint point = point_of(rows.data() + point_width * i);
    apex.push_back(arc_to_apex(point));
    advance(point, steps[static_cast<std::size_t>(i)]);
    store(point, moved);
  }
  return py::make_tuple(to_numpy(std::move(moved), {n, point_width}), to_numpy(std::move(apex)));
}

py::tuple to_wire(const Array<double>& points, const Detector& detector, int layer, int wire) {
  const py::ssize_t n = points.ndim() == 2 ? points.shape(0) : 0;
  const auto rows = matrix(points, "points", n, point_width);
  const WireLayer& cells = detector.wires.at(static_cast<std::size_t>(layer));
  const Wire& line = cells.placed.at(static_cast<std::size_t>(wire));
  std::vector<double> moved, doca, arcs;
  std::vector<std::uint8_t> found;
  for (py::ssize_t i = 0; i < n; ++i) {
    HelixPoint point = point_of(rows.data() + point_width * i);
    Approach approach{};
    found.push_back(approach_wire(point, line, approach));
    doca.push_back(approach.doca);
    arcs.push_back(approach.arc);
    store(point, moved);
  }
  return py::make_tuple(to_numpy(std::move(moved), {n, point_width}), to_numpy(std::move(doca)),
                        to_numpy(std::move(arcs)), to_numpy(std::move(found)));
}

py::array_t<double> solid_fractions(const Detector& detector, int slab, const Array<double>& u,
                                    const Array<double>& v, const Array<double>& slope_u,
                                    const Array<double>& slope_v) {
  const Holes& holes = detector.slabs.at(static_cast<std::size_t>(slab)).holes;
  if (holes.pitch == 0) throw std::invalid_argument("solid_fraction: the slab has no holes");
  const py::ssize_t n = u.size();
  const auto us = column(u, "u", n), vs = column(v, "v", n), slopes_u = column(slope_u, "slope_u", n),
             slopes_v = column(slope_v, "slope_v", n);
  std::vector<double> out;
  out.reserve(us.size());
  for (std::size_t i = 0; i < us.size(); ++i)
    out.push_back(solid_fraction(holes, {us[i], vs[i], slopes_u[i], slopes_v[i]}));
  return to_numpy(std::move(out));
}

Detector with_acting(Detector detector, const Array<double>& acting) {
  const auto values = column(acting, "acting", static_cast<py::ssize_t>(detector.slabs.size()));
  for (std::size_t i = 0; i < detector.slabs.size(); ++i) detector.slabs[i].acting = values[i];
  return detector;
}

Detector with_unseen(Detector detector, const Array<double>& unseen) {
  const auto values = column(unseen, "unseen", static_cast<py::ssize_t>(detector.slabs.size()));
  for (std::size_t i = 0; i < detector.slabs.size(); ++i) set_unseen(detector.slabs[i], values[i]);
  return detector;
}

// Loss (GeV), its variance, and d(loss)/dp used by the fit.
py::tuple loss_of_fit(const Detector& detector, int slab, double path, double p, double mass, double charge,
                      double track_xi) {
  TrackMatter track;
  track.xi = track_xi;
  track.loss = detector.loss;
  track.error = detector.errors.constant;
  const LossMoments m = core_loss(slab_of(detector, slab), path, particle(p, mass, charge), track);
  return py::make_tuple(m.loss, m.variance, m.slope);
}

py::array_t<double> drawn_losses(const Detector& detector, int slab, double path, double p, double mass,
                                 double charge, std::uint64_t seed, std::size_t n) {
  const Kinematics k = particle(p, mass, charge);
  std::vector<double> values;
  for (std::size_t i = 0; i < n; ++i)
    values.push_back(sample_loss(slab_of(detector, slab), path, k, Stream(seed, i, 0), 0));
  return to_numpy(std::move(values));
}

const GapMatter& gap_of(const Detector& detector, int layer) {
  return detector.gaps.at(static_cast<std::size_t>(layer));
}

// A straight track that enters the gap at azimuth 0 and z = 0.
GapCrossing straight_crossing(const Detector& detector, int layer, double tanl, double slope) {
  const MeasuringLayer& at = detector.layers.at(static_cast<std::size_t>(layer));
  const double across = slope / std::sqrt(1 + slope * slope);
  HelixPoint entry{at.r_gap_in, 0, 0, std::sqrt(1 - across * across), across, tanl, 0};
  HelixPoint exit = entry;
  double arc = 0;
  if (!step_to_cylinder(exit, at.r_gap_out, arc))
    throw std::invalid_argument("slope: does not cross the gap");
  return {entry, exit, detector.bz, arc * std::sqrt(1 + tanl * tanl)};
}

struct CrossingRow : GapResult {
  static constexpr auto columns() {
    return std::tuple(Column("energy", &CrossingRow::energy), Column("electrons", &CrossingRow::electrons),
                      Column("deltas", &CrossingRow::deltas));
  }
};
struct DepositRow : Deposit {
  std::int64_t crossing;

  static constexpr auto columns() {
    return std::tuple(Column("deposit_crossing", &DepositRow::crossing), Column("deposit_x", &DepositRow::x),
                      Column("deposit_y", &DepositRow::y), Column("deposit_z", &DepositRow::z),
                      Column("deposit_dx", &DepositRow::dx), Column("deposit_dy", &DepositRow::dy),
                      Column("deposit_dz", &DepositRow::dz), Column("deposit_energy", &DepositRow::energy),
                      Column("deposit_electrons", &DepositRow::electrons),
                      Column("deposit_delta", &DepositRow::delta),
                      Column("deposit_origin", &DepositRow::origin));
  }
};

py::dict ionize_gap(const Detector& detector, int layer, double p, double mass, double charge, py::ssize_t n,
                    std::uint64_t seed, bool deltas, bool keep_clusters, double tanl, double slope) {
  const GapMatter& matter = gap_of(detector, layer);
  const GapCrossing crossing = straight_crossing(detector, layer, tanl, slope);
  const Kinematics k = particle(p, mass, charge);
  Columns<CrossingRow> crossings;
  Columns<DepositRow> made;
  {
    py::gil_scoped_release release;
    std::vector<Deposit> deposits;
    for (py::ssize_t i = 0; i < n; ++i) {
      const Stream stream(seed, static_cast<std::uint64_t>(i), 0);
      deposits.clear();
      crossings.push_back({ionize(matter, crossing, k, stream, 0, deltas, keep_clusters, deposits)});
      for (const Deposit& one : deposits) made.push_back({one, i});
    }
  }
  py::dict out = to_dict(std::move(crossings));
  add_columns(std::move(made), out);
  return out;
}

// The end point of an electron.
struct EndRow {
  double u, w, z, energy, way;  // mm, keV, mm
  double deposited;             // keV

  static constexpr auto columns() {
    return std::tuple(Column("u", &EndRow::u), Column("w", &EndRow::w), Column("z", &EndRow::z),
                      Column("energy", &EndRow::energy), Column("way", &EndRow::way),
                      Column("deposited", &EndRow::deposited));
  }
};

py::dict follow_electrons(const Detector& detector, int layer, double w, double energy, double outward,
                          py::ssize_t n, std::uint64_t seed) {
  const GapMatter& matter = gap_of(detector, layer);
  const Electron start{0, w, 0, std::sqrt(std::max(1 - outward * outward, 0.0)), outward, 0, energy};
  ElectronBatch batch;
  for (py::ssize_t i = 0; i < n; ++i) {
    batch.electrons.push_back(
        {&matter, detector.bz, Stream(seed, static_cast<std::uint64_t>(i), 0), 0, start});
  }
  follow(batch);
  Columns<EndRow> ends;
  for (const ElectronTask& one : batch.electrons) {
    double deposited = 0;
    for (std::size_t k = one.first; k != 0; k = batch.pieces[k].next) deposited += batch.pieces[k].energy;
    ends.push_back({.u = one.electron.u,
                    .w = one.electron.w,
                    .z = one.electron.z,
                    .energy = one.electron.energy,
                    .way = one.way,
                    .deposited = deposited});
  }
  return to_dict(std::move(ends));
}

py::array_t<double> amplitudes(const Array<double>& terms, double dt, const Array<double>& steps) {
  StepFilter<Shaper::most> filter(
      Shaper(matrix(terms, "terms", terms.ndim() == 2 ? terms.shape(0) : 0, 3), 0.0), dt);
  std::vector<double> found;
  for (const double step : column(steps, "steps")) found.push_back(filter.next(step));
  return to_numpy(std::move(found));
}

py::array_t<double> polya(double theta, std::uint64_t seed, std::uint32_t n) {
  const Stream stream(seed, 0, 0);
  std::vector<double> found;
  for (std::uint32_t i = 0; i < n; ++i) {
    ElectronDraws<double> draws(stream, 0, i);
    found.push_back(polya_gain(theta, draws));
  }
  return to_numpy(std::move(found));
}

py::tuple holes(double pitch, const Array<double>& u, const Array<double>& v) {
  const auto a = column(u, "u"), b = column(v, "v", u.size());
  std::vector<double> at_u(a.begin(), a.end()), at_v(b.begin(), b.end());
  for (std::size_t i = 0; i < at_u.size(); ++i) to_nearest_hole(pitch, at_u[i], at_v[i]);
  return py::make_tuple(to_numpy(std::move(at_u)), to_numpy(std::move(at_v)));
}

struct ShareRow {
  std::int32_t sheet, view, strip;
  double part, largest;

  static constexpr auto columns() {
    return std::tuple(Column("sheet", &ShareRow::sheet), Column("view", &ShareRow::view),
                      Column("strip", &ShareRow::strip), Column("part", &ShareRow::part),
                      Column("largest", &ShareRow::largest));
  }
};

// Charges on strips after a cloud of charge 1 for each view has crossed the induction gap, and the largest
// ones.
py::dict cloud(const Detector& detector, std::size_t layer, double phi, double z, double sigma_x,
               double sigma_z, const Array<double>& way,
               const std::pair<Array<double>, std::size_t>& induced) {
  constexpr double duration = 40, whole = 1000;  // ns, fC
  InducedCharge charges{.way = {},
                        .phases = static_cast<std::size_t>(induced.first.shape(1)) - 1,
                        .reach = induced.second,
                        .charge = {induced.first.data(), static_cast<std::size_t>(induced.first.size())}};
  std::ranges::copy(column(way, "way", InducedCharge::nodes), charges.way.begin());
  StripSignals<Widest> signals(detector.layers.at(layer), layer, detector.layers.size(), charges, duration);
  signals.begin(0, duration);
  induce_on_layer(detector.layers.at(layer), phi, z, {sigma_x, sigma_z}, {whole, whole}, signals.transit(7.3),
                  signals);
  signals.close(0);
  Columns<ShareRow> shares;
  signals.each([&](int s, int w, int i, const auto& source, CurrentSteps steps) {
    double charge = 0;  // integral of the current
    for (std::size_t t = 0; t < steps.size(); ++t) charge -= steps[t] * static_cast<double>(t) * time_step;
    shares.push_back(
        {.sheet = s, .view = w, .strip = i, .part = charge / whole, .largest = source.total / whole});
  });
  return to_dict(std::move(shares));
}

py::tuple line_of(const Array<double>& position, const Array<double>& charge, const Array<double>& height,
                  double stiffness) {
  const auto x = column(position, "position"), q = column(charge, "charge", position.size()),
             w = column(height, "height", position.size());
  std::vector<StripPoint> points;
  for (std::size_t i = 0; i < x.size(); ++i) points.push_back({x[i], q[i], w[i]});
  const Line line = fit_line(points, stiffness);
  return py::make_tuple(line.at_middle, line.slope, line.good);
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

struct Settled {
  std::vector<std::int64_t> track, hits, hit;

  static constexpr auto columns() {
    return std::tuple(Column("track", &Settled::track), Column("hits", &Settled::hits),
                      Column("hit", &Settled::hit));
  }
};

// For tests: tracks with nothing but hits compete.
py::dict settle(const py::dict& track_columns, const py::dict& entry_columns, const py::dict& hit_columns,
                double min_score) {
  Inputs of_track(track_columns, "tracks"), of_entry(entry_columns, "entries"), of_hit(hit_columns, "hits");
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
  Settled left;
  for (const FoundTrack& track : tracks) {
    left.track.push_back(track.holes);
    left.hits.push_back(static_cast<std::int64_t>(track.hits.size()));
    left.hit.insert(left.hit.end(), track.hits.begin(), track.hits.end());
  }
  return to_dict(std::move(left));
}

using RowOfFive = std::array<double, 5>;

template <class G>
RowOfFive five(const G& g) {
  RowOfFive found{};
  const Vector5 vector = vector5(g);
  std::ranges::copy(vector, found.begin());
  return found;
}

// A reference trajectory: the measurements that it meets with their gradients, its noise vectors, and the
// kinks in units of them.
struct Followed {
  std::vector<RowOfFive> rows, noise;
  std::vector<double> predicted, extent, noise_units;

  static constexpr auto columns() {
    return std::tuple(Column("rows", &Followed::rows), Column("noise", &Followed::noise),
                      Column("noise_units", &Followed::noise_units),
                      Column("predicted", &Followed::predicted), Column("extent", &Followed::extent));
  }

  template <class Noise>
  void add(const Noise& of_slab, const Kink<double>& kink, bool shifts) {
    if (of_slab.dip[4] == 0) return;
    const auto [turn, dip] = in_noise_units(kink);
    put(of_slab.turn, turn);
    put(of_slab.dip, dip);
    put(of_slab.straggling, 0);
    if (!shifts) return;
    put(of_slab.shift_across, 0);
    put(of_slab.shift_along, 0);
  }
  template <class G>
  void put(const G& g, double unit) {
    noise.push_back(five(g));
    noise_units.push_back(unit);
  }
};

// The reference stands at every wire, in a field map as well.
struct StandsAtWires : NoObserver {
  static constexpr bool stops_at_wires = true;
};

// Follows one helix through the material up to the last hit. `kink_array`: angles for every slab, or none.
// `spans`: whether wires in a field map are passed as in a fit.
py::dict reference(const Detector& detector, const Array<double>& helix, double mass,
                   const py::dict& hit_columns, const std::optional<Array<double>>& kink_array, bool spans) {
  std::span<const double> kinks;
  if (kink_array) kinks = matrix(*kink_array, "kinks", static_cast<py::ssize_t>(detector.slabs.size()), 2);
  const Perigee start = from_bes3(column(helix, "helix", 5).data());
  const auto n = static_cast<py::ssize_t>(py::len(hit_columns["kind"]));
  std::vector<Hit> row;
  HitColumns(detector, hit_columns, n).take(0, static_cast<std::size_t>(n), row);
  const std::vector<std::int8_t> no_sides(row.size(), 0);
  const std::span<const Hit> hits(row);
  const std::span<const std::int8_t> sides(no_sides);
  Group<double> group;
  if (std::isfinite(start.kappa) && start.kappa != 0) {
    GroupBuilder<double>(detector).build(std::span(&hits, 1), std::span(&sides, 1), group);
    set_kinks(group, kinks);
    const Species species = species_of(mass, 1, start.kappa);
    if (detector.field.is_uniform()) {
      Tracer<double>(detector, start, species, group).run(true);
    } else if (spans) {
      Tracer<double, FieldReference<double>>(detector, start, species, group).run(true);
    } else {
      Tracer<double, FieldReference<double>, StandsAtWires>(detector, start, species, group).run(true);
    }
  }
  Followed found;
  for (const GroupStep& step : group.steps) {
    for (std::int32_t s = step.first; s < step.last; ++s) {
      const Slot<double>& slot = group.slots[static_cast<std::size_t>(s)];
      if (!slot.met) continue;
      found.rows.push_back(five(slot.row));
      found.predicted.push_back(slot.predicted);
      found.extent.push_back(slot.extent);
    }
    const auto number = static_cast<std::size_t>(step.noise);
    if (!step.is_slab || !group.ahead[number]) continue;
    const bool shifts = detector.slabs[static_cast<std::size_t>(step.slab)].shifts;
    if (group.dense) {
      found.add(group.dense_noise[number], group.kinks[number], shifts);
    } else {
      found.add(group.noise[number], group.kinks[number], shifts);
    }
  }
  const std::size_t reached = found.predicted.size();
  py::dict result = to_dict(std::move(found));
  result["reached"] = reached;
  result["stopped"] = bool(group.stopped);
  return result;
}

py::array_t<double> seeds(const Detector& detector, const Array<std::int64_t>& hit_offsets,
                          const py::dict& hit_columns, const Array<double>& mass_array, SeedFrom from) {
  const auto offsets = hit_offsets_of(hit_offsets);
  const auto n_hits = static_cast<py::ssize_t>(offsets.back());
  const HitColumns columns(detector, hit_columns, n_hits);
  const auto side = columns.side();
  const auto mass = column(mass_array, "mass", static_cast<py::ssize_t>(offsets.size()) - 1);
  if (!std::ranges::all_of(mass, [](double value) { return value > 0 && value < HUGE_VAL; }))
    throw std::invalid_argument("mass: expected finite numbers above 0");
  std::vector<Hit> hits;
  std::vector<double> helix;
  for (std::size_t i = 0; i + 1 < offsets.size(); ++i) {
    const auto first = static_cast<std::size_t>(offsets[i]),
               count = static_cast<std::size_t>(offsets[i + 1]) - first;
    columns.take(first, count, hits);
    const auto seed = seed_helix(detector, hits, side.subspan(first, count), from, mass[i], 1.0, 1.0);
    constexpr double none = std::numeric_limits<double>::quiet_NaN();
    const Perigee h = seed ? seed->helix : Perigee{none, none, none, none, none};
    for (const double value : {h.d, seed ? wrap_angle(h.psi - 0.5 * pi) : none, h.kappa, h.z0, h.tanl})
      helix.push_back(value);
  }
  return to_numpy(std::move(helix), {static_cast<py::ssize_t>(offsets.size() - 1), 5});
}

py::array_t<double> function(const std::string& name, const Array<double>& values) {
  const auto in = column(values, "values");
  const Kernels& used = kernels();
  if (in.size() % static_cast<std::size_t>(used.lanes) != 0)
    throw std::invalid_argument("values: expected a multiple of the number of lanes");
  std::vector<double> out(in.size());
  used.function(name, in.data(), out.data(), in.size());
  return to_numpy(std::move(out));
}

py::tuple of_turns(const Array<double>& turns) {
  std::vector<double> sines, cosines;
  for (const double u : column(turns, "turns")) {
    const auto [sine, cosine] = sine_cosine_of_turn(u);
    sines.push_back(sine);
    cosines.push_back(cosine);
  }
  return py::make_tuple(to_numpy(std::move(sines)), to_numpy(std::move(cosines)));
}

}  // namespace

void bind_testing(py::module_& core) {
  py::module_ module = core.def_submodule("_testing", "Single steps of the core, for tests.");
  module.def(
      "philox4x32",
      [](Block counter, std::array<std::uint32_t, 2> key) { return philox4x32(counter, key[0], key[1]); },
      py::kw_only(), py::arg("counter"), py::arg("key"), "Four words of Philox4x32-10.");
  module.def(
      "step_to_cylinder", &to_cylinder, py::arg("points"), py::arg("radius"), py::kw_only(),
      py::arg("outward") = true,
      "Move helix points, rows of (x y z ux uy tanl w), to a cylinder: points, arcs, whether reached.");
  module.def("advance", &move_along, py::arg("points"), py::arg("arcs"),
             "Move helix points by transverse arcs: points, and the arc from each to its outermost point.");
  module.def("approach_wire", &to_wire, py::arg("points"), py::arg("detector"), py::arg("layer"),
             py::arg("wire"),
             "Move helix points to their closest approach to a wire: points, signed distances, arcs, whether "
             "found.");
  module.def("with_acting", &with_acting, py::arg("detector"), py::arg("acting"),
             "The detector with other matter that acts with its slabs, GeV^2.");
  module.def("with_unseen", &with_unseen, py::arg("detector"), py::arg("unseen"),
             "The detector with other shares of losses that the fit does not see.");
  module.def("core_loss", &loss_of_fit, py::arg("detector"), py::arg("slab"), py::kw_only(), py::arg("path"),
             py::arg("p"), py::arg("mass"), py::arg("charge") = 1.0, py::arg("track_xi"),
             "Loss (GeV), its variance, and d(loss)/dp used by the fit.");
  module.def("sample_loss", &drawn_losses, py::arg("detector"), py::arg("slab"), py::kw_only(),
             py::arg("path"), py::arg("p"), py::arg("mass"), py::arg("charge") = 1.0, py::arg("seed"),
             py::arg("n"), "Energy losses (GeV) by collisions of n particles in a slab.");
  module.def("solid_fraction", &solid_fractions, py::arg("detector"), py::arg("slab"), py::kw_only(),
             py::arg("u"), py::arg("v"), py::arg("slope_u"), py::arg("slope_v"),
             "Fraction (0 to 1) of straight lines through a slab with holes that is outside the holes; u, v "
             "in mm at the middle of the foil.");
  module.def(
      "ionize", &ionize_gap, py::arg("detector"), py::arg("layer"), py::kw_only(), py::arg("p"),
      py::arg("mass"), py::arg("charge") = 1.0, py::arg("n"), py::arg("seed"), py::arg("deltas"),
      py::arg("keep_clusters"), py::arg("tanl") = 0.0, py::arg("slope") = 0.0,
      "Deposits of n straight tracks through azimuth 0 in a drift gap; slope: r dphi/dr at the entry.");
  module.def(
      "follow_electrons", &follow_electrons, py::arg("detector"), py::arg("layer"), py::kw_only(),
      py::arg("w"), py::arg("energy"), py::arg("outward"), py::arg("n"), py::arg("seed"),
      "End points of n electrons that start at w (mm from the inner edge of the gap) with an energy (keV).");
  module.def("shaped", &amplitudes, py::arg("terms"), py::arg("dt"), py::arg("steps"),
             "Amplitude behind a shaper of terms (n, 3) for steps of the current at times dt apart.");
  module.def("polya_gains", &polya, py::arg("theta"), py::arg("seed"), py::arg("n"),
             "Gains of electrons relative to their mean.");
  module.def("nearest_holes", &holes, py::arg("pitch"), py::arg("u"), py::arg("v"),
             "Holes of a hexagonal lattice that are nearest to points (mm).");
  module.def("share_cloud", &cloud, py::arg("detector"), py::arg("layer"), py::arg("phi"), py::arg("z"),
             py::arg("sigma_x"), py::arg("sigma_z"), py::arg("way"), py::arg("induced"),
             "Charges of a cloud on the strips of both views at the end, and the largest ones before.");
  module.def("turn_between", &turn_between, py::arg("from_x"), py::arg("from_y"), py::arg("to_x"),
             py::arg("to_y"), "Angle from one direction to another.");
  module.def("profile_below", &profile_below, py::arg("edge"), py::arg("a"), py::arg("b"), py::arg("sigma"),
             "Part up to an edge of a charge that is uniform from a to b, smeared by a Gaussian.");
  module.def("fit_line", &line_of, py::arg("position"), py::arg("charge"), py::arg("height"),
             py::arg("stiffness") = 0.0,
             "Position at height 0, slope, and whether there is a line, of strips with charge and height.");
  module.def("count_ranges", &count_ranges, py::arg("first"), py::arg("last"),
             "Counts of 192 counters of ranges, the largest count, and where it is.");
  module.def(
      "settle_tracks", &settle, py::kw_only(), py::arg("tracks"), py::arg("entries"), py::arg("hits"),
      py::arg("min_score"),
      "Competition of tracks (score, number of hits) for hits (on a wire, along the beam); entries are "
      "the hits of the tracks, one after the other, and their gains. Returns the numbers of the tracks "
      "that remain, the best first, and their hits.");
  module.def("reference", &reference, py::arg("detector"), py::arg("helix"), py::arg("mass"), py::arg("hits"),
             py::arg("kinks") = py::none(), py::kw_only(), py::arg("spans") = false,
             "Follow one helix, scattered by `kinks` (rad, two for every slab), through its hits, and with "
             "`spans` past the wires in a field map: predicted "
             "values, their rows by (dr, phi0, kappa, dz, tanl), the noise vectors of the matter, and the "
             "kinks in units of them.");
  py::native_enum<SeedFrom>(module, "SeedFrom", "enum.Enum", "What the first helix is drawn through.")
      .value("wires", SeedFrom::wires)
      .value("wires_and_clusters", SeedFrom::wires_and_clusters)
      .value("azimuths", SeedFrom::azimuths)
      .finalize();
  module.def("seeds", &seeds, py::arg("detector"), py::kw_only(), py::arg("hit_offsets"), py::arg("hits"),
             py::arg("mass"), py::arg("source"),
             "First helix of each row of hit_offsets, (n, 5) in the parameters of the tracks table; NaN if "
             "there is none.");
  module.def("sine_cosine_of_turn", &of_turns, py::arg("turns"),
             "Sines and cosines of 2 pi times the turns.");
  module.def("function", &function, py::arg("name"), py::arg("values"),
             "Apply a function of the kernels in use: log, exp, sine, cosine, atan, azimuth, nearest.");
}

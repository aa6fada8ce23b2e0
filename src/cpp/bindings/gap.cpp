#include "bindings/gap.hpp"

#include <algorithm>
#include <cmath>

#include "matter/electrons.hpp"
#include "matter/ionization.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

std::vector<ElectronLayer> make_layers(const py::dict& columns) {
  const auto w_in = take<double>(columns, "w_in"), w_out = take<double>(columns, "w_out"),
             density = take<double>(columns, "density"), depth = take<double>(columns, "depth"),
             points = take<double>(columns, "electrons");
  const auto n = static_cast<std::size_t>(w_in.size());
  const auto at = matrix(points, "electrons", w_in.size(), 6 * electron_points);
  std::vector<ElectronLayer> layers(n);
  for (std::size_t i = 0; i < n; ++i) {
    layers[i] = {w_in.at(i), w_out.at(i), density.at(i), depth.at(i), {}};
    for (std::size_t j = 0; j < electron_points; ++j) {
      const auto* row = &at[6 * (i * electron_points + j)];
      layers[i].at[j] = {row[0], row[1], row[2], row[3], row[4], row[5]};
    }
  }
  return layers;
}

std::vector<DeltaSlice> make_slices(const py::dict& columns) {
  const auto w_in = take<double>(columns, "w_in"), w_out = take<double>(columns, "w_out"),
             least = take<double>(columns, "least_energy"), rate = take<double>(columns, "rate");
  std::vector<DeltaSlice> slices;
  for (py::ssize_t i = 0; i < w_in.size(); ++i)
    slices.push_back({w_in.at(i), w_out.at(i), least.at(i), rate.at(i)});
  return slices;
}

GapMatter make_gap(const py::dict& gap) {
  GapMatter matter{};
  matter.layers = make_layers(py::cast<py::dict>(gap["layers"]));
  matter.gap = py::cast<std::size_t>(gap["gap"]);
  matter.half_length = py::cast<double>(gap["half_length"]);
  matter.slices = make_slices(py::cast<py::dict>(gap["slices"]));
  matter.xi = py::cast<double>(gap["xi"]);
  matter.w_value = py::cast<double>(gap["w_value"]);
  const auto clusters = take<double>(gap, "clusters"), sizes = take<double>(gap, "sizes"),
             tail = take<double>(gap, "tail");
  std::ranges::copy(column(clusters, "clusters", loss_points), std::back_inserter(matter.clusters));
  for (const double share : column(sizes, "sizes"))
    matter.sizes.push_back(static_cast<std::uint32_t>(std::min(share * 0x1p32, 0x1p32 - 1)));
  std::ranges::copy(column(tail, "tail"), std::back_inserter(matter.tail));
  if (matter.sizes.size() + 1 != largest_cluster + matter.tail.size())
    throw std::invalid_argument("sizes: expected one for each number of electrons up to " +
                                std::to_string(largest_cluster) + " and one for each range of tail");
  return matter;
}

const GapMatter& gap_of(const Detector& detector, int layer) {
  return detector.gaps.at(static_cast<std::size_t>(layer));
}

// A straight track that enters the gap at azimuth 0 and z = 0.
GapCrossing straight_crossing(const Detector& detector, int layer, double tanl, double slope) {
  const CgemLayer& at = detector.cgem.at(static_cast<std::size_t>(layer));
  const double across = slope / std::sqrt(1 + slope * slope);
  HelixPoint entry{at.r_gap_in, 0, 0, std::sqrt(1 - across * across), across, tanl, 0};
  HelixPoint exit = entry;
  double arc = 0;
  if (!step_to_cylinder(exit, at.r_gap_out, arc))
    throw std::invalid_argument("slope: does not cross the gap");
  return {entry, exit, detector.bz, arc * std::sqrt(1 + tanl * tanl)};
}

template <class T, class Row, class Value>
py::array_t<T> pick(const std::vector<Row>& rows, Value value) {
  std::vector<T> column;
  column.reserve(rows.size());
  for (const Row& row : rows) column.push_back(static_cast<T>(value(row)));
  return to_numpy(std::move(column));
}

py::dict run(const Detector& detector, int layer, double p, double mass, double charge, py::ssize_t n,
             std::uint64_t seed, bool deltas, bool keep_clusters, double tanl, double slope) {
  const GapMatter& matter = gap_of(detector, layer);
  const GapCrossing crossing = straight_crossing(detector, layer, tanl, slope);
  const Kinematics k(p, mass, projectile_of(mass, charge));
  std::vector<GapResult> results;
  std::vector<Deposit> deposits;
  std::vector<std::int64_t> owners;
  {
    py::gil_scoped_release release;
    for (py::ssize_t i = 0; i < n; ++i) {
      const Stream stream(seed, static_cast<std::uint64_t>(i), 0);
      results.push_back(ionize(matter, crossing, k, stream, 0, deltas, keep_clusters, deposits));
      owners.resize(deposits.size(), i);
    }
  }
  py::dict d;
  d["energy"] = pick<double>(results, [](const GapResult& r) { return r.energy; });
  d["electrons"] = pick<std::int32_t>(results, [](const GapResult& r) { return r.electrons; });
  d["deltas"] = pick<std::int32_t>(results, [](const GapResult& r) { return r.deltas; });
  d["deposit_crossing"] = to_numpy(std::move(owners));
  d["deposit_x"] = pick<double>(deposits, [](const Deposit& s) { return s.x; });
  d["deposit_y"] = pick<double>(deposits, [](const Deposit& s) { return s.y; });
  d["deposit_z"] = pick<double>(deposits, [](const Deposit& s) { return s.z; });
  d["deposit_dx"] = pick<double>(deposits, [](const Deposit& s) { return s.dx; });
  d["deposit_dy"] = pick<double>(deposits, [](const Deposit& s) { return s.dy; });
  d["deposit_dz"] = pick<double>(deposits, [](const Deposit& s) { return s.dz; });
  d["deposit_energy"] = pick<double>(deposits, [](const Deposit& s) { return s.energy; });
  d["deposit_electrons"] = pick<std::int32_t>(deposits, [](const Deposit& s) { return s.electrons; });
  d["deposit_delta"] = pick<std::int32_t>(deposits, [](const Deposit& s) { return s.delta; });
  d["deposit_origin"] = pick<std::int8_t>(deposits, [](const Deposit& s) { return s.origin; });
  return d;
}

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
  const auto& rows = batch.electrons;
  const auto deposited = [&batch](const ElectronTask& f) {
    double sum = 0;
    for (std::size_t k = f.first; k != 0; k = batch.pieces[k].next) sum += batch.pieces[k].energy;
    return sum;
  };
  py::dict d;
  d["u"] = pick<double>(rows, [](const ElectronTask& f) { return f.electron.u; });
  d["w"] = pick<double>(rows, [](const ElectronTask& f) { return f.electron.w; });
  d["z"] = pick<double>(rows, [](const ElectronTask& f) { return f.electron.z; });
  d["energy"] = pick<double>(rows, [](const ElectronTask& f) { return f.electron.energy; });
  d["way"] = pick<double>(rows, [](const ElectronTask& f) { return f.way; });
  d["deposited"] = pick<double>(rows, deposited);
  return d;
}

}  // namespace

std::vector<GapMatter> cgemit::bindings::make_gaps(const py::list& gaps) {
  std::vector<GapMatter> found;
  for (const py::handle gap : gaps) found.push_back(make_gap(py::cast<py::dict>(gap)));
  return found;
}

void bind_gap(py::module_& module) {
  module.attr("ELECTRON_GRID_FIRST") = electron_grid_first;
  module.attr("ELECTRON_STEPS") = electron_steps;
  module.attr("ELECTRON_POINTS") = electron_points;
  testing(module).def(
      "ionize", &run, py::arg("detector"), py::arg("layer"), py::kw_only(), py::arg("p"), py::arg("mass"),
      py::arg("charge") = 1.0, py::arg("n"), py::arg("seed"), py::arg("deltas"), py::arg("keep_clusters"),
      py::arg("tanl") = 0.0, py::arg("slope") = 0.0,
      "Deposits of n straight tracks through azimuth 0 in a drift gap; slope: r dphi/dr at the entry.");
  testing(module).def(
      "follow_electrons", &follow_electrons, py::arg("detector"), py::arg("layer"), py::kw_only(),
      py::arg("w"), py::arg("energy"), py::arg("outward"), py::arg("n"), py::arg("seed"),
      "End points of n electrons that start at w (mm from the inner edge of the gap) with an energy (keV).");
}

#include "bindings/gap.hpp"

#include <algorithm>

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
  if (gap.empty()) return matter;
  matter.layers = make_layers(py::cast<py::dict>(gap["layers"]));
  matter.gap = py::cast<std::size_t>(gap["gap"]);
  matter.z_min = py::cast<double>(gap["z_min"]);
  matter.z_max = py::cast<double>(gap["z_max"]);
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

}  // namespace

std::vector<GapMatter> cgemit::bindings::make_gaps(const py::list& gaps) {
  std::vector<GapMatter> found;
  for (const py::handle gap : gaps) found.push_back(make_gap(py::cast<py::dict>(gap)));
  return found;
}

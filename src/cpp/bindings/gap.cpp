#include "bindings/gap.hpp"

#include <algorithm>
#include <iterator>

#include "bindings/fields.hpp"
#include "bindings/settings.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

GapMatter read_gap(const py::dict& gap, const std::string& where, Problems& problems) {
  GapMatter matter{};
  if (gap.empty()) return matter;
  Settings in(where, gap);
  const py::dict layers = in["layers"], slices = in["slices"];
  matter.gap = in["gap"];
  matter.z_min = in["z_min"];
  matter.z_max = in["z_max"];
  matter.xi = in["xi"];
  matter.w_value = in["w_value"];
  const Array<double> clusters = in["clusters"], sizes = in["sizes"], tail = in["tail"];
  in.check(problems);
  matter.layers = Inputs(layers, where + " layers").read_rows<ElectronLayer>(problems);
  matter.slices = Inputs(slices, where + " slices").read_rows<DeltaSlice>(problems);
  if (!problems.empty()) return matter;
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

std::vector<GapMatter> cgemit::bindings::read_gaps(const py::list& gaps, Problems& problems) {
  std::vector<GapMatter> found;
  for (const py::handle gap : gaps)
    found.push_back(
        read_gap(py::cast<py::dict>(gap), "gaps[" + std::to_string(found.size()) + "]", problems));
  return found;
}

#include "matter/foil.hpp"

#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

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

}  // namespace

void bind_foil(py::module_& module) {
  testing(module).def(
      "solid_fraction", &solid_fractions, py::arg("detector"), py::arg("slab"), py::kw_only(), py::arg("u"),
      py::arg("v"), py::arg("slope_u"), py::arg("slope_v"),
      "Fraction (0 to 1) of straight lines through a slab with holes that is outside the holes; u, v "
      "in mm at the middle of the foil.");
}

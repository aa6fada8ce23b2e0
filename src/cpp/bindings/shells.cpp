#include "detector/shells.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "bindings/arrays.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

using Elements = std::vector<std::tuple<std::int64_t, double, double, double>>;

Material make_material(double x0, double xi, const Array<double>& log_term, const Elements& elements) {
  Material made{.x0 = x0, .xi = xi, .log_term = {}, .components = {}, .elements = {}};
  std::ranges::copy(column(log_term, "log_term", loss_points), made.log_term.begin());
  for (const auto& [number, z, a, moles] : elements) {
    made.elements.push_back(number);
    made.components.push_back({.z = z, .a = a, .moles = moles});
  }
  return made;
}

py::tuple sum_of(const std::vector<const Material*>& materials, const std::vector<double>& r_in,
                 const std::vector<double>& r_out) {
  if (materials.empty() || r_in.size() != materials.size() || r_out.size() != materials.size())
    throw std::invalid_argument("sum_shells: expected at least one material, with r_in and r_out for each");
  std::vector<MaterialShell> shells;
  for (std::size_t i = 0; i < materials.size(); ++i) {
    if (materials[i] == nullptr) throw std::invalid_argument("sum_shells: got None, expected a Material");
    shells.push_back({.material = materials[i], .r_in = r_in[i], .r_out = r_out[i]});
  }
  ShellSums sums = sum_shells(shells);
  std::vector<double> elements;
  for (const Component& one : sums.components) elements.insert(elements.end(), {one.z, one.a, one.moles});
  const auto n = static_cast<py::ssize_t>(sums.components.size());
  return py::make_tuple(sums.radius, sums.spread, sums.x0, sums.xi, to_numpy(std::move(sums.log_terms)),
                        to_numpy(std::move(elements), {n, 3}));
}

}  // namespace

void bind_shells(py::module_& module) {
  py::class_<Material>(module, "Material", "What 1 mm of a material adds to a slab.")
      .def(py::init(&make_material), py::kw_only(), py::arg("x0"), py::arg("xi"), py::arg("log_term"),
           py::arg("elements"));
  module.def(
      "sum_shells", &sum_of, py::kw_only(), py::arg("materials"), py::arg("r_in"), py::arg("r_out"),
      "Neighbouring shells as one slab: radius and spread (mm), X/X0, xi (GeV), log_terms, and Z, A and "
      "mol/cm2 of each element, a row of three.");
}

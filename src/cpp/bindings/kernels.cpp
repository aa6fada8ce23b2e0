#include "kernels/kernels.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bindings/arrays.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

py::array_t<double> function(const std::string& name, const Array<double>& values) {
  const auto in = column(values, "values");
  const Kernels& used = kernels();
  if (in.size() % static_cast<std::size_t>(used.lanes) != 0)
    throw std::invalid_argument("values: expected a multiple of the number of lanes");
  std::vector<double> out(in.size());
  used.function(name, in.data(), out.data(), in.size());
  return to_numpy(std::move(out));
}

}  // namespace

void bind_kernels(py::module_& module) {
  module.def("isa", [] { return std::string(kernels().isa); }, "Name of the instruction set in use.");
  module.def("lanes", [] { return kernels().lanes; }, "Tracks that its kernels handle side by side.");
  testing(module).def(
      "function", &function, py::arg("name"), py::arg("values"),
      "Apply a function of the kernels in use: log, exp, sine, cosine, atan, azimuth, nearest.");
  module.def("processor_runs", &processor_runs, py::arg("isa"), "Whether this processor runs such code.");
  module.def("use_kernels", &use_kernels, py::arg("path"), "Open and use the kernels of this library.");
  module.def("use_scalar_kernels", &use_scalar_kernels, "Use the plain scalar kernels.");
}

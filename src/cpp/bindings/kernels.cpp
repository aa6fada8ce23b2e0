#include "kernels/kernels.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

namespace py = pybind11;
using namespace cgemit;

void bind_kernels(py::module_& module) {
  module.def("isa", [] { return std::string(kernels().isa); }, "Name of the instruction set in use.");
  module.def("lanes", [] { return kernels().lanes; }, "Tracks that its kernels handle side by side.");
  module.def("processor_runs", &processor_runs, py::arg("isa"), "Whether this processor runs such code.");
  module.def("use_kernels", &use_kernels, py::arg("path"), "Open and use the kernels of this library.");
  module.def("use_scalar_kernels", &use_scalar_kernels, "Use the plain scalar kernels.");
}

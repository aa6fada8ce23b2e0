// Table of contents of the compiled module.
#include <pybind11/pybind11.h>

void bind_status(pybind11::module_& module);
void bind_interrupt(pybind11::module_& module);
void bind_rng(pybind11::module_& module);
void bind_field(pybind11::module_& module);
void bind_detector(pybind11::module_& module);
void bind_shells(pybind11::module_& module);
void bind_matter(pybind11::module_& module);
void bind_simulate(pybind11::module_& module);
void bind_analog(pybind11::module_& module);
void bind_digitize(pybind11::module_& module);
void bind_background(pybind11::module_& module);
void bind_cluster(pybind11::module_& module);
void bind_hits(pybind11::module_& module);
void bind_find(pybind11::module_& module);
void bind_tables(pybind11::module_& module);
void bind_truth(pybind11::module_& module);
void bind_fit(pybind11::module_& module);
void bind_kernels(pybind11::module_& module);
void bind_states(pybind11::module_& module);
void bind_covariance(pybind11::module_& module);
void bind_testing(pybind11::module_& core);

PYBIND11_MODULE(_core, module, pybind11::mod_gil_not_used()) {
  module.doc() = "Compiled core of cgemit: kernels on columns of numbers.";
  bind_status(module);
  bind_interrupt(module);
  bind_rng(module);
  bind_field(module);
  bind_detector(module);
  bind_shells(module);
  bind_matter(module);
  bind_simulate(module);
  bind_analog(module);
  bind_digitize(module);
  bind_background(module);
  bind_cluster(module);
  bind_hits(module);
  bind_find(module);
  bind_tables(module);
  bind_truth(module);
  bind_fit(module);
  bind_kernels(module);
  bind_states(module);
  bind_covariance(module);
  bind_testing(module);
}

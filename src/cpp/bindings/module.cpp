// Table of contents of the compiled module. Its submodules are named as the folders of the core.
#include <pybind11/pybind11.h>

using Module = pybind11::module_;

void bind_status(Module& common);
void bind_interrupt(Module& common);
void bind_rng(Module& common);
void bind_tables(Module& common);
void bind_kernels(Module& kernels);
void bind_models(Module& matter);
void bind_field(Module& detector);
void bind_shells(Module& detector);
void bind_detector(Module& detector);
void bind_matter(Module& matter);
void bind_helices(Module& kalman);
void bind_strip_delays(Module& readout);
void bind_covariance(Module& covariance);
void bind_simulate(Module& simulation);
void bind_analog(Module& simulation);
void bind_digitize(Module& simulation);
void bind_background(Module& simulation);
void bind_cluster(Module& reconstruction);
void bind_hits(Module& reconstruction);
void bind_find(Module& reconstruction);
void bind_fit(Module& reconstruction);
void bind_states(Module& reconstruction);
void bind_truth(Module& truth);
void bind_calibration(Module& calibration);
void bind_testing(Module& core);

PYBIND11_MODULE(_core, core, pybind11::mod_gil_not_used()) {
  core.doc() = "Compiled core of cgemit: kernels on columns of numbers.";
  Module common = core.def_submodule("common", "Statuses, random numbers, checks of tables, interrupts.");
  bind_status(common);
  bind_interrupt(common);
  bind_rng(common);
  bind_tables(common);
  Module kernels = core.def_submodule("kernels", "The kernels in use.");
  bind_kernels(kernels);
  Module detector = core.def_submodule("detector", "The detector as plain numbers, and its field.");
  Module matter = core.def_submodule("matter", "Scattering, energy loss, and species that decay.");
  bind_models(matter);  // a detector names them
  bind_field(detector);
  bind_shells(detector);
  bind_detector(detector);
  bind_matter(matter);
  Module kalman = core.def_submodule("kalman", "Helices and their covariances.");
  bind_helices(kalman);
  Module readout = core.def_submodule("readout", "What digitizing and clustering both know.");
  bind_strip_delays(readout);
  Module covariance = core.def_submodule("covariance", "Resolutions without events.");
  bind_covariance(covariance);
  Module simulation = core.def_submodule("simulation", "Particles to digis.");
  bind_simulate(simulation);
  bind_analog(simulation);
  bind_digitize(simulation);
  bind_background(simulation);
  Module reconstruction = core.def_submodule("reconstruction", "Digis to tracks.");
  bind_cluster(reconstruction);
  bind_hits(reconstruction);
  bind_find(reconstruction);
  bind_fit(reconstruction);
  bind_states(reconstruction);
  Module truth = core.def_submodule("truth", "Links of hits and tracks to particles.");
  bind_truth(truth);
  Module calibration = core.def_submodule("calibration", "Constants of the detector from tracks.");
  bind_calibration(calibration);
  bind_testing(core);
}

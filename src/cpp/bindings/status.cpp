#include "common/status.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>

namespace py = pybind11;
using namespace cgemit;

void bind_status(py::module_& module) {
  py::native_enum<TransportStatus>(module, "TransportStatus", "enum.IntEnum",
                                   "How the simulation of a particle ended.")
      .value("outside", TransportStatus::outside)
      .value("end", TransportStatus::end)
      .value("curled", TransportStatus::curled)
      .value("stopped", TransportStatus::stopped)
      .value("neutral", TransportStatus::neutral)
      .value("left_field", TransportStatus::left_field)
      .value("decayed", TransportStatus::decayed)
      .value("at_rest", TransportStatus::at_rest)
      .value("out_of_range", TransportStatus::out_of_range)
      .finalize();
  py::native_enum<FitStatus>(module, "FitStatus", "enum.IntEnum", "How the fit of a track ended.")
      .value("ok", FitStatus::ok)
      .value("too_few_hits", FitStatus::too_few_hits)
      .value("seed_failed", FitStatus::seed_failed)
      .value("does_not_reach", FitStatus::does_not_reach)
      .value("stopped", FitStatus::stopped)
      .value("not_converged", FitStatus::not_converged)
      .value("not_positive_definite", FitStatus::not_positive_definite)
      .value("left_field", FitStatus::left_field)
      .value("unconstrained", FitStatus::unconstrained)
      .value("hits_left_out", FitStatus::hits_left_out)
      .value("large_chi2", FitStatus::large_chi2)
      .finalize();
  py::native_enum<StateStatus>(module, "StateStatus", "enum.IntEnum",
                               "Whether a fitted track has a state at a requested surface.")
      .value("ok", StateStatus::ok)
      .value("not_fitted", StateStatus::not_fitted)
      .value("does_not_reach", StateStatus::does_not_reach)
      .value("stopped", StateStatus::stopped)
      .value("left_field", StateStatus::left_field)
      .finalize();
}

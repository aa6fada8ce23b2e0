#include "simulation/transport/simulate.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <optional>

#include "bindings/fields.hpp"
#include "bindings/interrupt.hpp"
#include "bindings/matter.hpp"
#include "kernels/kernels.hpp"
#include "simulation/transport/slabs.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

py::dict run_simulate(const Detector& detector, const py::dict& particles, Fluctuations fluctuations,
                      bool deltas, bool steps, const std::optional<DecayTable>& decays, int half_turns,
                      std::uint64_t seed) {
  if (half_turns < 1 || half_turns > most_half_turns)
    throw std::invalid_argument("half_turns: got " + std::to_string(half_turns) + ", expected 1 to " +
                                std::to_string(most_half_turns));
  Inputs of_particles(particles, "particles");
  const auto in = of_particles.read<ParticleColumns>();
  const SimulateSettings settings{.fluctuations = fluctuations,
                                  .deltas = deltas,
                                  .steps = steps,
                                  .decays = decays ? &*decays : nullptr,
                                  .half_turns = half_turns,
                                  .interrupted = interrupted};
  Simulated out;
  {
    py::gil_scoped_release release;
    kernels().simulate(detector, in, settings, seed, out);
  }
  throw_if_interrupted();
  py::dict result;
  result["status"] = to_numpy(std::move(out.status));
  result["truths"] = to_dict(std::move(out.truths));
  result["steps"] = to_dict(std::move(out.steps));
  result["wire_truths"] = to_dict(std::move(out.wire_truths));
  result["decays"] = to_dict(std::move(out.decays));
  return result;
}

py::dict pass_slabs(const Detector& detector, double p, double mass, double charge, std::size_t n,
                    std::uint64_t seed, std::uint64_t first) {
  SlabResults out;
  {
    py::gil_scoped_release release;
    out = through_slabs(detector, particle(p, mass, charge), first, n, seed);
  }
  return to_dict(std::move(out));
}

}  // namespace

void bind_simulate(py::module_& module) {
  py::native_enum<Fluctuations>(module, "Fluctuations", "enum.IntEnum",
                                "What the simulation draws at random.")
      .value("full", Fluctuations::full)
      .value("gaussian", Fluctuations::gaussian)
      .value("off", Fluctuations::off)
      .finalize();
  module.def("simulate", &run_simulate, py::arg("detector"), py::arg("particles"), py::kw_only(),
             py::arg("fluctuations"), py::arg("deltas") = true, py::arg("steps") = false,
             py::arg("decays") = py::none(), py::arg("half_turns") = 1, py::arg("seed"),
             "Transport particles through the detector; columns of `truths`, `steps`, `wire_truths` and "
             "`decays`, and `status`.");
  module.def(
      "through_slabs", &pass_slabs, py::arg("detector"), py::kw_only(), py::arg("p"), py::arg("mass"),
      py::arg("charge"), py::arg("n"), py::arg("seed"), py::arg("first") = 0,
      "Pass n particles through the detector's slabs as plane layers at normal incidence, counting from "
      "number `first`: columns angle_1, angle_2 (rad), shift_1, shift_2 (mm), loss (GeV), status.");
}

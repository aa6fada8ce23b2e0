#include "simulation/digitize/analog.hpp"

#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/digi_tables.hpp"
#include "bindings/gain_maps.hpp"
#include "bindings/inputs.hpp"
#include "bindings/part.hpp"
#include "bindings/settings.hpp"
#include "kernels/kernels.hpp"
#include "simulation/digitize/induced.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

std::vector<LayerDrift> layer_drift(const py::dict& table, const Detector& detector) {
  Inputs in(table, "velocity");
  const std::array<const char*, 14> names = {"velocity",  "tan_lorentz", "sigma_x",    "sigma_par", "sigma_l",
                                             "shift",     "delay",       "induction",  "first_phi", "first_z",
                                             "cloud_phi", "cloud_z",     "hole_pitch", "w_value"};
  std::array<std::span<const double>, 14> columns;
  for (std::size_t k = 0; k < names.size(); ++k) columns[k] = in.get<double>(names[k]);
  if (columns[0].size() != detector.cgem.size()) {
    throw std::invalid_argument("drift: expected one row for each CGEM layer");
  }
  std::vector<LayerDrift> found;
  for (std::size_t i = 0; i < columns[0].size(); ++i) {
    const auto at = [&](std::size_t k) { return columns[k][i]; };
    found.push_back({at(0), at(1), at(2), at(3), at(4), at(5), at(6), at(7), at(8), at(9), at(10), at(11),
                     at(12), at(13)});
  }
  return found;
}

ElectronPhysics electron_physics(const py::dict& values) {
  Settings in("physics", values);
  const ElectronPhysics physics{.survival = in["survival"],
                                .gain = in["gain"],
                                .polya = in["polya"],
                                .diffusion = in["diffusion"],
                                .first_gain = in["first_gain"],
                                .lorentz = in["lorentz"]};
  in.check();
  return physics;
}

Shaper shaper(const py::tuple& terms_and_delay) {
  const auto terms = terms_and_delay[0].cast<Array<double>>();
  return Shaper({terms.data(), static_cast<std::size_t>(terms.size())}, terms_and_delay[1].cast<double>());
}

Chip chip(const py::dict& values) {
  const auto kind = values["kind"].cast<std::string>();
  if (kind != "tiger" && kind != "apv25") {
    throw std::invalid_argument("kind: got " + kind + ", expected tiger or apv25");
  }
  return {.kind = kind == "tiger" ? ChipKind::tiger : ChipKind::apv25,
          .timing = shaper(values["timing"].cast<py::tuple>()),
          .charge = shaper(values["charge"].cast<py::tuple>()),
          .threshold = {values["threshold_x"].cast<double>(), values["threshold_v"].cast<double>()},
          .noise = values["noise"].cast<double>(),
          .jitter = values["jitter"].cast<double>(),
          .saturation = values["saturation"].cast<double>(),
          .sample_delay = values["sample_delay"].cast<double>(),
          .clock = values["clock"].cast<double>(),
          .samples = values["samples"].cast<int>()};
}

// ns: delays and times of a chip and of the drift are at most as long.
constexpr double longest = 1e6;

void check(Problems& problems, const LayerDrift& drift, std::size_t layer) {
  const Part part(problems, "drift", layer);
  part.within("velocity", drift.velocity, tiny, far);
  part.within("tan_lorentz", drift.tan_lorentz, -far, far);
  for (const double sigma : {drift.sigma_x, drift.sigma_par, drift.sigma_l})
    part.within("sigma_x, sigma_par, sigma_l", sigma, 0, far);
  part.within("shift", drift.shift, -far, far);
  part.within("delay", drift.delay, -longest, longest);
  part.within("induction", drift.induction, tiny, longest);
  for (const double width : {drift.first_phi, drift.first_z, drift.cloud_phi, drift.cloud_z})
    part.within("first_phi, first_z, cloud_phi, cloud_z", width, 0, far);
  part.within("hole_pitch", drift.hole_pitch, 0, far);
  part.within("w_value", drift.w_value, tiny, far);
}

void check(Problems& problems, const ElectronPhysics& physics) {
  const Part part(problems, "physics");
  part.within("survival", physics.survival, 0, 1);
  part.within("gain", physics.gain, 0, far);
  part.within("polya", physics.polya, 0, HUGE_VAL);
  part.within("diffusion", physics.diffusion, 0, far);
  part.within("first_gain", physics.first_gain, tiny, far);
}

void check(Problems& problems, const char* name, const Shaper& shaper) {
  const Part part(problems, name);
  part.within("delay", shaper.delay, -longest, longest);
  for (std::size_t k = 0; k < shaper.n; ++k) {
    part.within("a", shaper.terms[k].a, -far, far);
    part.within("b", shaper.terms[k].b, -far, far);
    part.within("rate", shaper.terms[k].rate, tiny, far);
  }
}

void check(Problems& problems, const Chip& chip) {
  constexpr double most_samples = 10'000;
  check(problems, "timing", chip.timing);
  check(problems, "charge", chip.charge);
  const Part part(problems, "chip");
  part.within("threshold_x", chip.threshold[0], -far, HUGE_VAL);
  part.within("threshold_v", chip.threshold[1], -far, HUGE_VAL);
  part.within("noise", chip.noise, 0, far);
  part.within("jitter", chip.jitter, 0, far);
  part.within("saturation", chip.saturation, 0, HUGE_VAL);
  part.within("sample_delay", chip.sample_delay, -longest, longest);
  if (chip.kind == ChipKind::tiger) return;
  part.within("samples", chip.samples, 1, most_samples);
  part.within("clock", chip.clock, tiny, longest / most_samples);
}

void check(const AnalogModel& readout) {
  Problems problems;
  for (std::size_t i = 0; i < readout.drift.size(); ++i) check(problems, readout.drift[i], i);
  check(problems, readout.physics);
  check(problems, readout.chip);
  const Part part(problems, "read-out");
  part.within("share_spread", readout.share_spread, 0, far);
  part.within("neighbour", readout.neighbour, 0, 1);
  part.within("second_neighbour", readout.second, 0, 1);
  problems.raise("read_out_analog");
}

py::dict analog(const Detector& detector, const py::dict& table, const py::dict& step_table,
                const py::dict& drift, const py::dict& physics, const py::dict& chip_values,
                double share_spread, double neighbour, double second_neighbour, std::uint64_t seed,
                const py::dict& gain_table, bool induced) {
  Inputs in(table, "event"), step_in(step_table, "event");
  const TruthColumns truths = truth_columns(in);
  const StepColumns steps = step_columns(step_in);
  const std::vector<LayerDrift> layers = layer_drift(drift, detector);
  const AnalogModel readout{.drift = layers,
                            .physics = electron_physics(physics),
                            .chip = chip(chip_values),
                            .share_spread = share_spread,
                            .neighbour = neighbour,
                            .second = second_neighbour,
                            .seed = seed};
  check(readout);
  const GainMaps gains = gain_maps(detector, gain_table);
  DigiColumns digis;
  {
    py::gil_scoped_release release;
    kernels().read_out_analog(detector, truths, steps, readout, gains, digis);
    if (induced)
      digis = with_induced(detector, digis, {readout.chip.threshold, readout.chip.saturation, seed});
  }
  return to_dict(std::move(digis));
}

}  // namespace

void bind_analog(py::module_& module) {
  module.def("read_out_analog", &analog, py::arg("detector"), py::arg("truths"), py::arg("steps"),
             py::kw_only(), py::arg("drift"), py::arg("physics"), py::arg("chip"), py::arg("share_spread"),
             py::arg("neighbour"), py::arg("second_neighbour"), py::arg("seed"),
             py::arg("gains") = py::dict(), py::arg("induced") = false,
             "Columns of digis from columns of truths and steps: electrons, avalanches, currents, chip.");
}

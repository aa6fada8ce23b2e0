#include "simulation/digitize/analog.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "bindings/arrays.hpp"
#include "bindings/fields.hpp"
#include "bindings/gain_maps.hpp"
#include "bindings/interrupt.hpp"
#include "bindings/part.hpp"
#include "bindings/settings.hpp"
#include "kernels/kernels.hpp"
#include "readout/strip_delays.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

std::vector<LayerDrift> layer_drift(const py::dict& table, const Detector& detector) {
  Inputs in(table, "drift", static_cast<py::ssize_t>(detector.layers.size()));
  return in.read_rows<LayerDrift>();
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

// Terms of a shaper, rows of three, and its delay.
using ShaperNumbers = std::pair<Array<double>, double>;

Shaper shaper(const ShaperNumbers& numbers) {
  return {{numbers.first.data(), static_cast<std::size_t>(numbers.first.size())}, numbers.second};
}

Chip chip(const py::dict& values) {
  Settings in("chip", values);
  const std::string kind = in["kind"];
  const Amplifier amplifier{.threshold = {in["threshold_x"], in["threshold_v"]},
                            .noise = in["noise"],
                            .jitter = in["jitter"],
                            .saturation = in["saturation"]};
  const ShaperNumbers timing = in["timing"], charge = in["charge"];
  const double sample_delay = in["sample_delay"], clock = in["clock"];
  const std::int64_t samples = in["samples"];
  in.check();
  return chip_of(kind, {.amplifier = amplifier,
                        .timing = shaper(timing),
                        .charge = shaper(charge),
                        .sample_delay = sample_delay,
                        .clock = clock,
                        .samples = samples});
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

void check(Problems& problems, const Amplifier& amplifier) {
  const Part part(problems, "chip");
  part.within("threshold_x", amplifier.threshold[0], -far, HUGE_VAL);
  part.within("threshold_v", amplifier.threshold[1], -far, HUGE_VAL);
  part.within("noise", amplifier.noise, 0, far);
  part.within("jitter", amplifier.jitter, 0, far);
  part.within("saturation", amplifier.saturation, 0, HUGE_VAL);
}

void check(Problems& problems, const ChipNumbers& chip) {
  constexpr double most_samples = 10'000;
  check(problems, "timing", chip.timing);
  check(problems, "charge", chip.charge);
  check(problems, chip.amplifier);
  const Part part(problems, "chip");
  part.within("sample_delay", chip.sample_delay, -longest, longest);
  part.within("samples", static_cast<double>(chip.samples), 1, most_samples);
  part.within("clock", chip.clock, tiny, longest / most_samples);
}

void check(Problems& problems, const Chip& chip) {
  std::visit([&](const ChipNumbers& one) { check(problems, one); }, chip);
}

// `charges`: an array (planes, places, nodes, strips); `reach`: the strips on either side of an avalanche.
InducedCharge induced_charge(const Array<double>& way, const Array<double>& charges, std::size_t reach,
                             std::size_t planes) {
  constexpr std::size_t nodes = InducedCharge::nodes;
  InducedCharge found{.way = {}, .phases = 0, .reach = reach, .charge = {}};
  const auto nodes_at = column(way, "way", static_cast<py::ssize_t>(nodes));
  std::ranges::copy(nodes_at, found.way.begin());
  for (std::size_t k = 0; k < nodes; ++k) {
    if (!(found.way[k] >= (k == 0 ? 0 : std::nextafter(found.way[k - 1], 1)) && found.way[k] <= 1))
      throw std::invalid_argument("way: expected growing numbers from 0 to 1");
  }
  if (charges.ndim() != 4 || charges.shape(1) < 2 || reach > 10'000)
    throw std::invalid_argument("induced: expected charges (planes, places, nodes, strips)");
  found.phases = static_cast<std::size_t>(charges.shape(1)) - 1;
  found.charge = {charges.data(), static_cast<std::size_t>(charges.size())};
  if (found.charge.size() != planes * found.plane_size())
    throw std::invalid_argument("induced: expected X and V of all layers, 5 nodes and 2 reach + 1 strips");
  for (const double charge : found.charge) {
    if (!(std::abs(charge) <= 1 + tiny))
      throw std::invalid_argument("induced: expected charges of at most 1");
  }
  return found;
}

void check(const AnalogModel& readout) {
  Problems problems;
  for (std::size_t i = 0; i < readout.drift.size(); ++i) check(problems, readout.drift[i], i);
  check(problems, readout.physics);
  check(problems, readout.chip);
  const Part part(problems, "readout");
  part.within("share_spread", readout.share_spread, 0, far);
  problems.raise("read_out_analog");
}

py::dict analog(const Detector& detector, const py::dict& table, const py::dict& step_table,
                const py::dict& drift, const py::dict& physics, const py::dict& chip_values,
                double share_spread, const Array<double>& way,
                const std::pair<Array<double>, std::size_t>& induced, std::uint64_t seed,
                const py::dict& gain_table) {
  Inputs in(table, "truths"), step_in(step_table, "steps");
  const auto truths = in.read<TruthColumns>();
  const auto steps = step_in.read<StepColumns>();
  const std::vector<LayerDrift> layers = layer_drift(drift, detector);
  const AnalogModel readout{
      .drift = layers,
      .physics = electron_physics(physics),
      .chip = chip(chip_values),
      .share_spread = share_spread,
      .induced = induced_charge(way, induced.first, induced.second, 2 * detector.layers.size()),
      .seed = seed,
      .interrupted = interrupted};
  check(readout);
  const GainMaps gains = gain_maps(detector, gain_table);
  Columns<DigiRow> digis;
  {
    py::gil_scoped_release release;
    kernels().read_out_analog(detector, truths, steps, readout, gains, digis);
  }
  throw_if_interrupted();
  return to_dict(std::move(digis));
}

Array<double> delays(const py::dict& chip_values, const py::dict& view, const Array<double>& way,
                     const std::pair<Array<double>, std::size_t>& induced, const py::dict& tracks,
                     const Array<double>& slopes, const Array<double>& charges) {
  const Chip front_end = chip(chip_values);
  Settings in("view", view);
  const StripView strips{.induced = induced_charge(way, induced.first, induced.second, 1),
                         .pitch = in["pitch"],
                         .gap = in["gap"],
                         .velocity = in["velocity"],
                         .duration = in["duration"],
                         .margin = in["margin"],
                         .threshold = in["threshold"]};
  in.check();
  Problems problems;
  check(problems, front_end);
  const Part part(problems, "view");
  for (const double length : {strips.pitch, strips.gap, strips.velocity, strips.duration, strips.threshold})
    part.within("pitch, gap, velocity, duration, threshold", length, tiny, far);
  part.within("margin", strips.margin, 0, far);
  part.within("gap / velocity", strips.gap / strips.velocity + strips.duration, 0, longest);
  const auto first = take<std::int64_t>(tracks, "first");
  const auto height = take<double>(tracks, "height"), charge = take<double>(tracks, "charge"),
             place = take<double>(tracks, "place");
  const DriftingTracks drifting{column(first, "first", place.size() + 1), column(height, "height"),
                                column(charge, "charge", height.size()), column(place, "place")};
  for (const double one : drifting.height) part.within("height", one, -0.5, 0.5);
  for (const double one : drifting.charge) part.within("charge", one, 0, far);
  const auto n = static_cast<std::int64_t>(drifting.height.size());
  if (drifting.first.front() != 0 || drifting.first.back() != n || !std::ranges::is_sorted(drifting.first))
    problems.add("first: expected growing numbers from 0 to the number of clusters");
  const auto values = column(charges, "charges");
  if (values.empty() || !std::ranges::is_sorted(values) || !(values.front() > 0))
    problems.add("charges: expected growing ones above 0");
  problems.raise("strip_delays");
  const auto found = strip_delays(front_end, strips, drifting, column(slopes, "slopes"), values);
  return Array<double>({slopes.size(), charges.size()}, found.data());
}

}  // namespace

void bind_analog(py::module_& module) {
  module.def("read_out_analog", &analog, py::arg("detector"), py::arg("truths"), py::arg("steps"),
             py::kw_only(), py::arg("drift"), py::arg("physics"), py::arg("chip"), py::arg("share_spread"),
             py::arg("way"), py::arg("induced"), py::arg("seed"), py::arg("gains") = py::dict(),
             "Columns of digis from columns of truths and steps: electrons, avalanches, currents, chip.");
}

void bind_strip_delays(py::module_& module) {
  module.def("strip_delays", &delays, py::kw_only(), py::arg("chip"), py::arg("view"), py::arg("way"),
             py::arg("induced"), py::arg("tracks"), py::arg("slopes"), py::arg("charges"),
             "Delays (ns) with which a chip measures charges, after their mean arrival, (slopes, charges).");
}

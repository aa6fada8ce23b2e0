#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/fields.hpp"
#include "bindings/gain_maps.hpp"
#include "kernels/kernels.hpp"
#include "simulation/digitize/binary.hpp"
#include "simulation/digitize/efficiency.hpp"
#include "simulation/digitize/gaussian.hpp"
#include "simulation/digitize/projection.hpp"
#include "simulation/digitize/wires.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// One number for each layer.
std::span<const double> per_layer(const Array<double>& w_values, const Detector& detector) {
  return column(w_values, "w_values", static_cast<py::ssize_t>(detector.layers.size()));
}

py::dict strips(const Detector& detector, const py::dict& table, const py::dict& step_table, double gain,
                const Array<double>& w_values, double threshold, const py::dict& gain_table) {
  Inputs in(table, "truths"), step_in(step_table, "steps");
  const auto truths = in.read<TruthColumns>();
  const auto steps = step_in.read<StepColumns>();
  const BinaryReadout readout{
      .gain = gain, .w_values = per_layer(w_values, detector), .threshold = threshold};
  const GainMaps gains = gain_maps(detector, gain_table);
  Columns<DigiRow> digis;
  {
    py::gil_scoped_release release;
    digis = read_out_strips(detector, truths, steps, readout, gains);
  }
  return to_dict(std::move(digis));
}

Array<bool> seen(const Detector& detector, const py::dict& table, const Array<double>& efficiency,
                 std::uint64_t seed) {
  Inputs in(table, "truths");
  const auto truths = in.read<TruthColumns>();
  const std::span<const double> of_layers = per_layer(efficiency, detector);
  Array<bool> found(static_cast<py::ssize_t>(truths.size()));
  seen_crossings(detector, truths, of_layers, seed, {found.mutable_data(), truths.size()});
  return found;
}

py::dict smeared(const Detector& detector, const py::dict& table, double gain, const Array<double>& w_values,
                 const py::dict& errors, std::uint64_t seed) {
  Inputs in(table, "truths");
  const auto truths = in.read<TruthColumns>();
  Inputs of_layers(errors, "errors", static_cast<py::ssize_t>(detector.layers.size()));
  const auto rows = of_layers.read_rows<PositionErrors>();
  const GaussianReadout readout{
      .errors = rows, .gain = gain, .w_values = per_layer(w_values, detector), .seed = seed};
  Columns<DigiRow> digis;
  {
    py::gil_scoped_release release;
    digis = smear_positions(detector, truths, readout);
  }
  return to_dict(std::move(digis));
}

py::dict profiles(const Detector& detector, const py::dict& table, const py::dict& step_table, double gain,
                  const Array<double>& w_values, double sigma, double threshold, double noise,
                  std::uint64_t seed, const py::dict& gain_table) {
  Inputs in(table, "truths"), step_in(step_table, "steps");
  const auto truths = in.read<TruthColumns>();
  const auto steps = step_in.read<StepColumns>();
  const ProjectionReadout readout{.gain = gain,
                                  .w_values = per_layer(w_values, detector),
                                  .sigma = sigma,
                                  .threshold = threshold,
                                  .noise = noise,
                                  .seed = seed};
  const GainMaps gains = gain_maps(detector, gain_table);
  Columns<DigiRow> digis;
  {
    py::gil_scoped_release release;
    digis = read_out_profiles(detector, truths, steps, readout, gains);
  }
  return to_dict(std::move(digis));
}

py::dict wires(const Detector& detector, const py::dict& table, bool reveal_sides, std::uint64_t seed) {
  Inputs in(table, "wire_truths");
  const auto truths = in.read<WireTruthColumns>();
  Columns<WireHitRow> hits;
  {
    py::gil_scoped_release release;
    hits = kernels().read_out_wires(detector, truths, {reveal_sides, seed});
  }
  return to_dict(std::move(hits));
}

}  // namespace

void bind_digitize(py::module_& module) {
  module.def("read_out_strips", &strips, py::arg("detector"), py::arg("truths"), py::arg("steps"),
             py::kw_only(), py::arg("gain"), py::arg("w_values"), py::arg("threshold"),
             py::arg("gains") = py::dict(),
             "Columns of digis from columns of truths and steps: binary readout.");
  module.def("seen_crossings", &seen, py::arg("detector"), py::arg("truths"), py::kw_only(),
             py::arg("efficiency"), py::arg("seed"),
             "Which crossings the layers see, (truths,), by the efficiency of each layer.");
  module.def("smear_positions", &smeared, py::arg("detector"), py::arg("truths"), py::kw_only(),
             py::arg("gain"), py::arg("w_values"), py::arg("errors"), py::arg("seed"),
             "Columns of digis from columns of truths: readout without strips.");
  module.def("read_out_profiles", &profiles, py::arg("detector"), py::arg("truths"), py::arg("steps"),
             py::kw_only(), py::arg("gain"), py::arg("w_values"), py::arg("sigma"), py::arg("threshold"),
             py::arg("noise"), py::arg("seed"), py::arg("gains") = py::dict(),
             "Columns of digis from columns of truths and steps: charge profiles integrated over strips.");
  module.def("read_out_wires", &wires, py::arg("detector"), py::arg("wire_truths"), py::kw_only(),
             py::arg("reveal_sides"), py::arg("seed"), "Columns of wire_hits from columns of wire_truths.");
}

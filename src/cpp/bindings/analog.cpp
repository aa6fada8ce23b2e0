#include "simulation/digitize/analog.hpp"

#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/digi_tables.hpp"
#include "bindings/gain_maps.hpp"
#include "bindings/inputs.hpp"
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
    if (!(at(0) > 0) || !(at(7) > 0)) {
      throw std::invalid_argument("drift: expected positive velocities and induction times");
    }
    found.push_back({at(0), at(1), at(2), at(3), at(4), at(5), at(6), at(7), at(8), at(9), at(10), at(11),
                     at(12), at(13)});
  }
  return found;
}

ElectronPhysics electron_physics(const py::dict& values) {
  return {.survival = values["survival"].cast<double>(),
          .gain = values["gain"].cast<double>(),
          .polya = values["polya"].cast<double>(),
          .diffusion = values["diffusion"].cast<double>(),
          .first_gain = values["first_gain"].cast<double>(),
          .lorentz = values["lorentz"].cast<bool>(),
          .correlated = values["correlated"].cast<bool>()};
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

py::array_t<double> amplitudes(const Array<double>& terms, double dt, const Array<double>& steps) {
  StepFilter<Shaper::most> filter(
      Shaper(matrix(terms, "terms", terms.ndim() == 2 ? terms.shape(0) : 0, 3), 0.0), dt);
  std::vector<double> found;
  for (const double step : column(steps, "steps")) found.push_back(filter.next(step));
  return to_numpy(std::move(found));
}

py::array_t<double> polya(double theta, std::uint64_t seed, std::uint32_t n) {
  const Stream stream(seed, 0, 0);
  std::vector<double> found;
  for (std::uint32_t i = 0; i < n; ++i) {
    ElectronDraws<double> draws(stream, 0, i);
    found.push_back(polya_gain(theta, draws));
  }
  return to_numpy(std::move(found));
}

py::tuple holes(double pitch, const Array<double>& u, const Array<double>& v) {
  const auto a = column(u, "u"), b = column(v, "v", u.size());
  std::vector<double> at_u(a.begin(), a.end()), at_v(b.begin(), b.end());
  for (std::size_t i = 0; i < at_u.size(); ++i) to_nearest_hole(pitch, at_u[i], at_v[i]);
  return py::make_tuple(to_numpy(std::move(at_u)), to_numpy(std::move(at_v)));
}

py::dict cloud(const Detector& detector, std::size_t layer, double phi, double z, double sigma_x,
               double sigma_z) {
  std::vector<std::int32_t> sheet, view, strip;
  std::vector<double> part;
  const auto give = [&](int s, int w, int i, Parts parts) {
    for (const double p : parts) {
      sheet.push_back(s);
      view.push_back(w);
      strip.push_back(i++);
      part.push_back(p);
    }
  };
  share_on_layer<Widest>(detector.cgem.at(layer), phi, z, sigma_x, sigma_z, give);
  py::dict out;
  out["sheet"] = to_numpy(std::move(sheet));
  out["view"] = to_numpy(std::move(view));
  out["strip"] = to_numpy(std::move(strip));
  out["part"] = to_numpy(std::move(part));
  return out;
}

}  // namespace

void bind_analog(py::module_& module) {
  module.def("read_out_analog", &analog, py::arg("detector"), py::arg("truths"), py::arg("steps"),
             py::kw_only(), py::arg("drift"), py::arg("physics"), py::arg("chip"), py::arg("share_spread"),
             py::arg("neighbour"), py::arg("second_neighbour"), py::arg("seed"),
             py::arg("gains") = py::dict(), py::arg("induced") = false,
             "Columns of digis from columns of truths and steps: electrons, avalanches, currents, chip.");
  testing(module).def(
      "induced_by",
      [](double charge) {
        return py::make_tuple(induced_probability(charge), induced_share(charge), induced_delay(charge));
      },
      py::arg("charge"), "Probability, share and mean delay (ns) of what a strip induces on a neighbour.");
  testing(module).def(
      "shaped", &amplitudes, py::arg("terms"), py::arg("dt"), py::arg("steps"),
      "Amplitude behind a shaper of terms (n, 3) for steps of the current at times dt apart.");
  testing(module).def("polya_gains", &polya, py::arg("theta"), py::arg("seed"), py::arg("n"),
                      "Gains of electrons relative to their mean.");
  testing(module).def("nearest_holes", &holes, py::arg("pitch"), py::arg("u"), py::arg("v"),
                      "Holes of a hexagonal lattice that are nearest to points (mm).");
  testing(module).def("share_cloud", &cloud, py::arg("detector"), py::arg("layer"), py::arg("phi"),
                      py::arg("z"), py::arg("sigma_x"), py::arg("sigma_z"),
                      "Parts of a cloud on the strips of both views.");
}

#include "simulation/transport/simulate.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <optional>

#include "bindings/arrays.hpp"
#include "bindings/interrupt.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// Modes and products come as flat columns: mode i belongs to species[of_species[i]], product k to mode
// of_mode[k].
DecayTable make_decays(const py::dict& species, const py::dict& modes, const py::dict& products) {
  const auto pdg = take<std::int32_t>(species, "pdg"), of_species = take<std::int32_t>(modes, "species"),
             spectrum = take<std::int32_t>(modes, "spectrum"), of_mode = take<std::int32_t>(products, "mode"),
             product_pdg = take<std::int32_t>(products, "pdg"),
             charge = take<std::int32_t>(products, "charge");
  const auto mass = take<double>(species, "mass"), lifetime = take<double>(species, "lifetime"),
             fraction = take<double>(modes, "fraction"), product_mass = take<double>(products, "mass");
  DecayTable table;
  for (py::ssize_t i = 0; i < pdg.size(); ++i)
    table.species.push_back({.pdg = pdg.at(i), .mass = mass.at(i), .lifetime = lifetime.at(i), .modes = {}});
  std::vector<std::vector<DecayProduct>> products_of(static_cast<std::size_t>(of_species.size()));
  for (py::ssize_t k = 0; k < of_mode.size(); ++k) {
    products_of.at(static_cast<std::size_t>(of_mode.at(k)))
        .push_back({.pdg = product_pdg.at(k), .charge = charge.at(k), .mass = product_mass.at(k)});
  }
  for (py::ssize_t i = 0; i < of_species.size(); ++i) {
    table.species.at(static_cast<std::size_t>(of_species.at(i)))
        .modes.push_back({.fraction = fraction.at(i),
                          .spectrum = static_cast<DecaySpectrum>(spectrum.at(i)),
                          .products = std::move(products_of[static_cast<std::size_t>(i)])});
  }
  for (const UnstableSpecies& one : table.species) check(one);
  return table;
}

py::dict run_simulate(const Detector& detector, const py::dict& particles, Fluctuations fluctuations,
                      bool deltas, bool steps, const std::optional<DecayTable>& decays, int half_turns,
                      std::uint64_t seed) {
  if (half_turns < 1 || half_turns > most_half_turns)
    throw std::invalid_argument("half_turns: got " + std::to_string(half_turns) + ", expected 1 to " +
                                std::to_string(most_half_turns));
  const auto event = take<std::int64_t>(particles, "event");
  const auto particle = take<std::int32_t>(particles, "particle"), pdg = take<std::int32_t>(particles, "pdg");
  const auto charge = take<std::int8_t>(particles, "charge");
  const auto mass = take<double>(particles, "mass"), x = take<double>(particles, "x"),
             y = take<double>(particles, "y"), z = take<double>(particles, "z"),
             px = take<double>(particles, "px"), py_ = take<double>(particles, "py"),
             pz = take<double>(particles, "pz");
  const bool has_times = particles.contains("decay_time");
  const auto decay_time = has_times ? take<double>(particles, "decay_time") : Array<double>(0);
  const py::ssize_t n = event.size();
  const ParticleColumns in{.event = column(event, "event", n),
                           .particle = column(particle, "particle", n),
                           .pdg = column(pdg, "pdg", n),
                           .charge = column(charge, "charge", n),
                           .mass = column(mass, "mass", n),
                           .x = column(x, "x", n),
                           .y = column(y, "y", n),
                           .z = column(z, "z", n),
                           .px = column(px, "px", n),
                           .py = column(py_, "py", n),
                           .pz = column(pz, "pz", n),
                           .decay_time = column(decay_time, "decay_time", has_times ? n : 0)};
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
  std::vector<std::int8_t> status;
  status.reserve(out.status.size());
  for (const TransportStatus s : out.status) status.push_back(static_cast<std::int8_t>(s));
  py::dict result;
  result["status"] = to_numpy(std::move(status));
  result["truths"] = to_dict(std::move(out.truths));
  result["steps"] = to_dict(std::move(out.steps));
  result["wire_truths"] = to_dict(std::move(out.wire_truths));
  result["decays"] = to_dict(std::move(out.decays));
  return result;
}

}  // namespace

void bind_simulate(py::module_& module) {
  py::native_enum<Fluctuations>(module, "Fluctuations", "enum.IntEnum",
                                "What the simulation draws at random.")
      .value("full", Fluctuations::full)
      .value("gaussian", Fluctuations::gaussian)
      .value("off", Fluctuations::off)
      .finalize();
  py::native_enum<DecaySpectrum>(module, "DecaySpectrum", "enum.IntEnum",
                                 "Distribution of the products' momenta in the rest frame.")
      .value("phase_space", DecaySpectrum::phase_space)
      .value("semileptonic", DecaySpectrum::semileptonic)
      .value("michel", DecaySpectrum::michel)
      .finalize();
  py::class_<DecayTable>(module, "DecayTable", "Species that decay in flight, and their modes.")
      .def(py::init(&make_decays), py::arg("species"), py::arg("modes"), py::arg("products"));
  module.def("simulate", &run_simulate, py::arg("detector"), py::arg("particles"), py::kw_only(),
             py::arg("fluctuations"), py::arg("deltas") = true, py::arg("steps") = false,
             py::arg("decays") = py::none(), py::arg("half_turns") = 1, py::arg("seed"),
             "Transport particles through the detector; columns of `truths`, `steps`, `wire_truths` and "
             "`decays`, and `status`.");
}

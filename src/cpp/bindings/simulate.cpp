#include "simulate/simulate.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

py::dict to_columns(Truths&& t) {
  py::dict d;
  d["event"] = to_numpy(std::move(t.event));
  d["particle"] = to_numpy(std::move(t.particle));
  d["layer"] = to_numpy(std::move(t.layer));
  d["entry_x"] = to_numpy(std::move(t.entry_x));
  d["entry_y"] = to_numpy(std::move(t.entry_y));
  d["entry_z"] = to_numpy(std::move(t.entry_z));
  d["exit_x"] = to_numpy(std::move(t.exit_x));
  d["exit_y"] = to_numpy(std::move(t.exit_y));
  d["exit_z"] = to_numpy(std::move(t.exit_z));
  d["r"] = to_numpy(std::move(t.r));
  d["phi"] = to_numpy(std::move(t.phi));
  d["z"] = to_numpy(std::move(t.z));
  d["px"] = to_numpy(std::move(t.px));
  d["py"] = to_numpy(std::move(t.py));
  d["pz"] = to_numpy(std::move(t.pz));
  d["path"] = to_numpy(std::move(t.path));
  d["time"] = to_numpy(std::move(t.time));
  d["energy"] = to_numpy(std::move(t.energy));
  d["secondaries"] = to_numpy(std::move(t.secondaries));
  return d;
}

py::dict to_columns(Steps&& s) {
  py::dict d;
  d["event"] = to_numpy(std::move(s.event));
  d["particle"] = to_numpy(std::move(s.particle));
  d["layer"] = to_numpy(std::move(s.layer));
  d["x"] = to_numpy(std::move(s.x));
  d["y"] = to_numpy(std::move(s.y));
  d["z"] = to_numpy(std::move(s.z));
  d["dx"] = to_numpy(std::move(s.dx));
  d["dy"] = to_numpy(std::move(s.dy));
  d["dz"] = to_numpy(std::move(s.dz));
  d["energy"] = to_numpy(std::move(s.energy));
  d["n_electrons"] = to_numpy(std::move(s.electrons));
  d["parent"] = to_numpy(std::move(s.parent));
  d["delta"] = to_numpy(std::move(s.delta));
  d["truth"] = to_numpy(std::move(s.truth));
  return d;
}

py::dict to_columns(WireTruths&& t) {
  py::dict d;
  d["event"] = to_numpy(std::move(t.event));
  d["particle"] = to_numpy(std::move(t.particle));
  d["layer"] = to_numpy(std::move(t.layer));
  d["wire"] = to_numpy(std::move(t.wire));
  d["doca"] = to_numpy(std::move(t.doca));
  d["side"] = to_numpy(std::move(t.side));
  d["x"] = to_numpy(std::move(t.x));
  d["y"] = to_numpy(std::move(t.y));
  d["z"] = to_numpy(std::move(t.z));
  d["time"] = to_numpy(std::move(t.time));
  return d;
}

py::dict run(const Detector& detector, const py::dict& particles, Fluctuations fluctuations, bool deltas,
             bool steps, std::uint64_t seed) {
  const auto event = take<std::int64_t>(particles, "event");
  const auto particle = take<std::int32_t>(particles, "particle");
  const auto charge = take<std::int8_t>(particles, "charge");
  const auto mass = take<double>(particles, "mass"), x = take<double>(particles, "x"),
             y = take<double>(particles, "y"), z = take<double>(particles, "z"),
             px = take<double>(particles, "px"), py_ = take<double>(particles, "py"),
             pz = take<double>(particles, "pz");
  const py::ssize_t n = event.size();
  const ParticleColumns in{column(event, "event", n),   column(particle, "particle", n),
                           column(charge, "charge", n), column(mass, "mass", n),
                           column(x, "x", n),           column(y, "y", n),
                           column(z, "z", n),           column(px, "px", n),
                           column(py_, "py", n),        column(pz, "pz", n)};
  Simulated out;
  {
    py::gil_scoped_release release;
    const auto kernel =
        detector.field.is_uniform() ? kernels().simulate : &cgemit::simulate;  // others go one by one
    kernel(detector, in, {fluctuations, deltas, steps}, seed, out);
  }
  std::vector<std::int8_t> status;
  status.reserve(out.status.size());
  for (const TransportStatus s : out.status) status.push_back(static_cast<std::int8_t>(s));
  py::dict result;
  result["status"] = to_numpy(std::move(status));
  result["truths"] = to_columns(std::move(out.truths));
  result["steps"] = to_columns(std::move(out.steps));
  result["wire_truths"] = to_columns(std::move(out.wire_truths));
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
  module.def("simulate", &run, py::arg("detector"), py::arg("particles"), py::kw_only(),
             py::arg("fluctuations"), py::arg("deltas") = true, py::arg("steps") = false, py::arg("seed"),
             "Transport particles through the detector; columns of `truths`, `steps` and `wire_truths`, and "
             "`status`.");
}

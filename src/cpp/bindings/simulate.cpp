#include "simulate/simulate.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

template <class Table>
py::dict to_columns(Table&& table) {
  py::dict columns;
  table.each_column([&](const char* name, auto& values) { columns[name] = to_numpy(std::move(values)); });
  return columns;
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
  const ParticleColumns in{.event = column(event, "event", n),
                           .particle = column(particle, "particle", n),
                           .charge = column(charge, "charge", n),
                           .mass = column(mass, "mass", n),
                           .x = column(x, "x", n),
                           .y = column(y, "y", n),
                           .z = column(z, "z", n),
                           .px = column(px, "px", n),
                           .py = column(py_, "py", n),
                           .pz = column(pz, "pz", n)};
  Simulated out;
  {
    py::gil_scoped_release release;
    kernels().simulate(detector, in, {fluctuations, deltas, steps}, seed, out);
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

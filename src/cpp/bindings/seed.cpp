#include "reconstruction/fit/seed.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "common/angles.hpp"

namespace py = pybind11;

namespace cgemit::bindings {

namespace {

py::array_t<double> seeds(const Detector& detector, const Array<std::int64_t>& hit_offsets,
                          const py::dict& hit_columns, const Array<double>& mass_array, SeedFrom from) {
  const auto offsets = hit_offsets_of(hit_offsets);
  const auto n_hits = static_cast<py::ssize_t>(offsets.back());
  const HitColumns columns(detector, hit_columns, n_hits);
  const auto side = columns.side();
  const auto mass = column(mass_array, "mass", static_cast<py::ssize_t>(offsets.size()) - 1);
  if (!std::ranges::all_of(mass, [](double value) { return value > 0 && value < HUGE_VAL; }))
    throw std::invalid_argument("mass: expected finite numbers above 0");
  std::vector<Hit> hits;
  std::vector<double> helix;
  for (std::size_t i = 0; i + 1 < offsets.size(); ++i) {
    const auto first = static_cast<std::size_t>(offsets[i]),
               count = static_cast<std::size_t>(offsets[i + 1]) - first;
    columns.take(first, count, hits);
    const auto seed = seed_helix(detector, hits, side.subspan(first, count), from, mass[i]);
    constexpr double none = std::numeric_limits<double>::quiet_NaN();
    const Perigee h = seed ? seed->helix : Perigee{none, none, none, none, none};
    for (const double value : {h.d, seed ? wrap_angle(h.psi - 0.5 * pi) : none, h.kappa, h.z0, h.tanl})
      helix.push_back(value);
  }
  return to_numpy(std::move(helix), {static_cast<py::ssize_t>(offsets.size() - 1), 5});
}

}  // namespace

}  // namespace cgemit::bindings

void bind_seed(py::module_& module) {
  using cgemit::SeedFrom;
  using cgemit::bindings::testing;
  py::native_enum<SeedFrom>(testing(module), "SeedFrom", "enum.Enum",
                            "What the first helix is drawn through.")
      .value("wires", SeedFrom::wires)
      .value("wires_and_clusters", SeedFrom::wires_and_clusters)
      .value("azimuths", SeedFrom::azimuths)
      .finalize();
  testing(module).def(
      "seeds", &cgemit::bindings::seeds, py::arg("detector"), py::kw_only(), py::arg("hit_offsets"),
      py::arg("hits"), py::arg("mass"), py::arg("source"),
      "First helix of each row of hit_offsets, (n, 5) in the parameters of the tracks table; NaN if "
      "there is none.");
}

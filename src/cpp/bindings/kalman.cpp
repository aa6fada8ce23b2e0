#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <optional>

#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "kalman/reference.hpp"

namespace py = pybind11;

namespace cgemit::bindings {

namespace {

py::dict reference(const Detector& detector, const Array<double>& helix, double mass,
                   const py::dict& hit_columns, const std::optional<Array<double>>& kink_array) {
  std::span<const double> kinks;
  if (kink_array) kinks = matrix(*kink_array, "kinks", static_cast<py::ssize_t>(detector.slabs.size()), 2);
  const auto row = column(helix, "helix", 5);
  const auto n = static_cast<py::ssize_t>(py::len(hit_columns["kind"]));
  std::vector<Hit> hits;
  HitColumns(detector, hit_columns, n).take(0, static_cast<std::size_t>(n), hits);
  const Reference out = trace(detector, from_bes3(row.data()), mass, hits, kinks);
  std::vector<double> rows, noise, noise_units = out.noise_units, predicted, extent;
  for (const Vector5& h : out.rows) rows.insert(rows.end(), h.begin(), h.end());
  for (const Vector5& g : out.noise) noise.insert(noise.end(), g.begin(), g.end());
  for (const Crossing& crossing : out.crossings) {
    predicted.push_back(crossing.predicted);
    extent.push_back(crossing.extent);
  }
  const auto n_rows = static_cast<py::ssize_t>(rows.size() / 5),
             n_noise = static_cast<py::ssize_t>(noise.size() / 5);
  py::dict result;
  result["rows"] = to_numpy(std::move(rows), {n_rows, 5});
  result["noise"] = to_numpy(std::move(noise), {n_noise, 5});
  result["noise_units"] = to_numpy(std::move(noise_units));
  result["predicted"] = to_numpy(std::move(predicted));
  result["extent"] = to_numpy(std::move(extent));
  result["reached"] = out.reached;
  result["stopped"] = out.stopped;
  return result;
}

}  // namespace

}  // namespace cgemit::bindings

void bind_kalman(py::module_& module) {
  using cgemit::bindings::testing;
  testing(module).def(
      "reference", &cgemit::bindings::reference, py::arg("detector"), py::arg("helix"), py::arg("mass"),
      py::arg("hits"), py::arg("kinks") = py::none(),
      "Follow one helix, scattered by `kinks` (rad, two for every slab), through its hits: predicted "
      "values, their rows by (dr, phi0, kappa, dz, tanl), the noise vectors of the matter, and the "
      "kinks in units of them.");
}

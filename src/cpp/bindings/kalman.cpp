#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <optional>

#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "common/angles.hpp"
#include "kalman/reference.hpp"

namespace py = pybind11;

namespace cgemit::bindings {

HitColumns::HitColumns(const Detector& detector, const py::dict& columns, py::ssize_t n)
    : detector_(detector) {
  const auto get = [&]<class T>(std::span<const T>& to, const char* name) {
    const auto array = bindings::take<T>(columns, name);
    held_.append(array);
    to = column(array, name, n);
  };
  get(kind_, "kind");
  get(layer_, "layer");
  get(element_, "element");
  get(size_, "size");
  get(value_, "value");
  get(sigma_, "sigma");
  for (std::size_t i = 0; i < detector.wires.size(); ++i) {
    const auto number = static_cast<std::size_t>(detector.wires[i].number);
    if (number >= wire_layers_.size()) wire_layers_.resize(number + 1, -1);
    wire_layers_[number] = static_cast<int>(i);
  }
}

void HitColumns::take(std::size_t first, std::size_t n, std::vector<Hit>& out) const {
  out.clear();
  for (std::size_t i = first; i < first + n; ++i) {
    int index = layer_[i];
    int limit = 0;
    if (kind_[i] == static_cast<std::uint8_t>(View::wire)) {
      const auto number = static_cast<std::size_t>(index);
      index = index >= 0 && number < wire_layers_.size() ? wire_layers_[number] : -1;
      if (index < 0) throw std::invalid_argument("layer: no wire layer of that number in the detector");
      limit = detector_.wires[static_cast<std::size_t>(index)].cells;
    } else if (kind_[i] > 2 || index < 0 || static_cast<std::size_t>(index) >= detector_.cgem.size()) {
      throw std::invalid_argument("kind, layer: no such CGEM layer in the detector");
    } else {
      limit = detector_.cgem[static_cast<std::size_t>(index)].sheets;
    }
    if (element_[i] < 0 || element_[i] >= limit)
      throw std::invalid_argument("element: no such wire or sheet in the layer");
    out.push_back({static_cast<View>(kind_[i]), index, element_[i], size_[i], value_[i], sigma_[i]});
  }
}

Perigee from_bes3(const double* row) {
  return {row[0], wrap_angle(row[1] + 0.5 * pi), row[2], row[3], row[4]};
}

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
  std::vector<double> rows, noise, pulls = out.pulls, predicted, extent;
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
  result["pulls"] = to_numpy(std::move(pulls));
  result["predicted"] = to_numpy(std::move(predicted));
  result["extent"] = to_numpy(std::move(extent));
  result["reached"] = out.reached;
  result["stopped"] = out.stopped;
  return result;
}

}  // namespace

}  // namespace cgemit::bindings

void bind_kalman(py::module_& module) {
  module.def(
      "reference", &cgemit::bindings::reference, py::arg("detector"), py::arg("helix"), py::arg("mass"),
      py::arg("hits"), py::arg("kinks") = py::none(),
      "Follow one helix, scattered by `kinks` (rad, two for every slab), through its hits: predicted values, "
      "their rows by (dr, phi0, kappa, dz, tanl), and the noise vectors of the matter, with how many of them "
      "the kinks are.");
}

#include <pybind11/pybind11.h>


#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "common/angles.hpp"
#include "kalman/reference.hpp"

namespace py = pybind11;

namespace cgemit::bindings {

std::vector<Hit> make_hits(const Detector& detector, const py::dict& columns, py::ssize_t n) {
  const auto kind_array = take<std::uint8_t>(columns, "kind");
  const auto layer_array = take<std::int32_t>(columns, "layer"),
             element_array = take<std::int32_t>(columns, "element"),
             size_array = take<std::int32_t>(columns, "size");
  const auto value_array = take<double>(columns, "value"), sigma_array = take<double>(columns, "sigma");
  const auto kind = column(kind_array, "kind", n);
  const auto layer = column(layer_array, "layer", n), element = column(element_array, "element", n),
             size = column(size_array, "size", n);
  const auto value = column(value_array, "value", n), sigma = column(sigma_array, "sigma", n);
  std::vector<int> index_of;  // by the experiment's layer number
  for (std::size_t i = 0; i < detector.wires.size(); ++i) {
    const auto number = static_cast<std::size_t>(detector.wires[i].number);
    if (number >= index_of.size()) index_of.resize(number + 1, -1);
    index_of[number] = static_cast<int>(i);
  }
  std::vector<Hit> hits(static_cast<std::size_t>(n));
  for (std::size_t i = 0; i < hits.size(); ++i) {
    int index = layer[i];
    int limit = 0;
    if (kind[i] == static_cast<std::uint8_t>(View::wire)) {
      index = index >= 0 && static_cast<std::size_t>(index) < index_of.size()
                  ? index_of[static_cast<std::size_t>(index)]
                  : -1;
      if (index < 0) throw std::invalid_argument("layer: no wire layer of that number in the detector");
      limit = detector.wires[static_cast<std::size_t>(index)].cells;
    } else if (kind[i] > 2 || index < 0 || static_cast<std::size_t>(index) >= detector.cgem.size()) {
      throw std::invalid_argument("kind, layer: no such CGEM layer in the detector");
    } else {
      limit = detector.cgem[static_cast<std::size_t>(index)].sheets;
    }
    if (element[i] < 0 || element[i] >= limit)
      throw std::invalid_argument("element: no such wire or sheet in the layer");
    hits[i] = {static_cast<View>(kind[i]), index, element[i], size[i], value[i], sigma[i]};
  }
  return hits;
}

Perigee from_bes3(const double* row) {
  return {row[0], wrap_angle(row[1] + 0.5 * pi), row[2], row[3], row[4]};
}

namespace {

py::dict reference(const Detector& detector, const Array<double>& helix, double mass,
                   const py::dict& hit_columns) {
  const auto row = column(helix, "helix", 5);
  const auto n = static_cast<py::ssize_t>(py::len(hit_columns["kind"]));
  const std::vector<Hit> hits = make_hits(detector, hit_columns, n);
  const Reference out = trace(detector, from_bes3(row.data()), mass, hits);
  std::vector<double> rows, noise, predicted, extent;
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
  result["predicted"] = to_numpy(std::move(predicted));
  result["extent"] = to_numpy(std::move(extent));
  result["reached"] = out.reached;
  result["stopped"] = out.stopped;
  return result;
}

}  // namespace

}  // namespace cgemit::bindings

void bind_kalman(py::module_& module) {
  module.def("reference", &cgemit::bindings::reference, py::arg("detector"), py::arg("helix"),
             py::arg("mass"), py::arg("hits"),
             "Follow one helix through its hits: predicted values, their rows by (dr, phi0, kappa, dz, "
             "tanl), and the "
             "noise vectors of the matter.");
}

#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/cluster_columns.hpp"
#include "bindings/inputs.hpp"
#include "cluster/clusters.hpp"
#include "cluster/positions.hpp"
#include "cluster/size_errors.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

DigiView digi_view(Inputs& in) {
  DigiView digis;
  digis.event = in.get<std::int64_t>("event");
  digis.layer = in.get<std::int32_t>("layer");
  digis.sheet = in.get<std::int32_t>("sheet");
  digis.view = in.get<std::int8_t>("view");
  digis.strip = in.get<std::int32_t>("strip");
  digis.charge = in.get<double>("charge");
  digis.time = in.get<double>("time");
  digis.truth = in.get<std::int64_t>("truth");
  digis.n_truths = in.get<std::int32_t>("n_truths");
  return digis;
}

py::dict of_strips(const Detector& detector, const py::dict& table, const Array<double>& err_x,
                   const Array<double>& err_v, bool by_charge) {
  Inputs in(table, "event");
  const DigiView digis = digi_view(in);
  const auto layers = static_cast<py::ssize_t>(detector.cgem.size());
  const py::ssize_t sizes = err_x.ndim() == 2 ? err_x.shape(1) : 0;
  if (sizes < 1) throw std::invalid_argument("err_x: expected shape (layers, sizes)");
  const ErrorTable errors{matrix(err_x, "err_x", layers, sizes), matrix(err_v, "err_v", layers, sizes),
                          static_cast<std::size_t>(sizes)};
  ClusterColumns found;
  {
    py::gil_scoped_release release;
    found = find_clusters(detector, digis, errors, by_charge ? Position::charge : Position::centre);
  }
  return to_dict(std::move(found));
}

py::dict of_positions(const Detector& detector, const py::dict& table, double err_x, double err_v) {
  Inputs in(table, "event");
  DigiView digis = digi_view(in);
  digis.position = in.get<double>("position");
  ClusterColumns found;
  {
    py::gil_scoped_release release;
    found = clusters_of_positions(detector, digis, err_x, err_v);
  }
  return to_dict(std::move(found));
}

py::array_t<double> errors_of_sizes(const Array<double>& extents, double pitch, std::size_t sizes) {
  return to_numpy(size_errors(column(extents, "extents"), pitch, sizes));
}

}  // namespace

void bind_cluster(py::module_& module) {
  module.def("find_clusters", &of_strips, py::arg("detector"), py::arg("digis"), py::kw_only(),
             py::arg("err_x"), py::arg("err_v"), py::arg("by_charge"),
             "Columns of clusters from columns of digis: contiguous strips.");
  module.def("clusters_of_positions", &of_positions, py::arg("detector"), py::arg("digis"), py::kw_only(),
             py::arg("err_x"), py::arg("err_v"),
             "Columns of clusters from columns of digis: read-out without strips.");
  module.def(
      "size_errors", &errors_of_sizes, py::arg("extents"), py::arg("pitch"), py::arg("sizes"),
      "RMS of the position error (mm) of clusters of 1 to `sizes` strips for a sample of extents (mm).");
}

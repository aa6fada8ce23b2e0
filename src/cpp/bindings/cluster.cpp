#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/cluster_columns.hpp"
#include "bindings/inputs.hpp"
#include "cluster/clusters.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

py::dict clusters(const Detector& detector, const py::dict& table, const Array<double>& err_x,
                  const Array<double>& err_v, bool by_charge) {
  Inputs in(table, "event");
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

}  // namespace

void bind_cluster(py::module_& module) {
  module.def("find_clusters", &clusters, py::arg("detector"), py::arg("digis"), py::kw_only(),
             py::arg("err_x"), py::arg("err_v"), py::arg("by_charge"),
             "Columns of clusters from columns of digis.");
}

#include "fit/fit.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

template <class Row, class Value>
std::vector<Value> take_column(const std::vector<Row>& rows, Value Row::* field) {
  std::vector<Value> out;
  out.reserve(rows.size());
  for (const Row& row : rows) out.push_back(row.*field);
  return out;
}

py::dict columns(const std::vector<FitRow>& rows) {
  const auto n = static_cast<py::ssize_t>(rows.size());
  std::vector<double> helix, covariance;
  std::vector<std::int32_t> ndf;
  std::vector<std::int8_t> status;
  helix.reserve(5 * rows.size());
  covariance.reserve(25 * rows.size());
  ndf.reserve(rows.size());
  status.reserve(rows.size());
  for (const FitRow& row : rows) {
    helix.insert(helix.end(), row.helix.begin(), row.helix.end());
    covariance.insert(covariance.end(), row.covariance.begin(), row.covariance.end());
    ndf.push_back(row.clusters + row.wires - 5);
    status.push_back(static_cast<std::int8_t>(row.status));
  }
  py::dict out;
  out["helix"] = to_numpy(std::move(helix), {n, 5});
  out["cov"] = to_numpy(std::move(covariance), {n, 5, 5});
  out["chi2"] = to_numpy(take_column(rows, &FitRow::chi2));
  out["ndf"] = to_numpy(std::move(ndf));
  out["n_clusters"] = to_numpy(take_column(rows, &FitRow::clusters));
  out["n_wires"] = to_numpy(take_column(rows, &FitRow::wires));
  out["n_outliers"] = to_numpy(take_column(rows, &FitRow::outliers));
  out["iterations"] = to_numpy(take_column(rows, &FitRow::iterations));
  out["status"] = to_numpy(std::move(status));
  return out;
}

py::dict run(const Detector& detector, const Array<std::int64_t>& hit_offsets, const py::dict& hit_columns,
             const Array<double>& mass_array, const Array<double>& start_array, const FitSettings& settings,
             bool residuals) {
  const auto offsets = column(hit_offsets, "hit_offsets");
  if (offsets.empty()) throw std::invalid_argument("hit_offsets: expected at least one entry");
  const auto n = offsets.size() - 1;
  const auto n_hits = static_cast<py::ssize_t>(offsets[n]);
  const auto mass = column(mass_array, "mass", static_cast<py::ssize_t>(n));
  const bool seeded = start_array.ndim() == 2 && start_array.shape(0) > 0;
  if (seeded) matrix(start_array, "start", static_cast<py::ssize_t>(n), 5);
  const auto side_array = take<std::int8_t>(hit_columns, "side");
  const auto side = column(side_array, "side", n_hits);
  const std::vector<Hit> hits = make_hits(detector, hit_columns, n_hits);
  for (std::size_t i = 0; i < n; ++i) {
    if (offsets[i] > offsets[i + 1] || offsets[i] < 0)
      throw std::invalid_argument("hit_offsets: expected to increase");
  }
  std::vector<Perigee> start;
  for (std::size_t i = 0; seeded && i < n; ++i) start.push_back(from_bes3(start_array.data() + 5 * i));
  std::vector<FitRow> rows(n);
  std::vector<HitRow> hit_rows(residuals ? hits.size() : 0);
  {
    py::gil_scoped_release release;
    kernels().fit(detector, {offsets, hits, side, mass, start}, settings,
                  {rows.data(), residuals ? hit_rows.data() : nullptr});
  }
  py::dict result = columns(rows);
  if (residuals) {
    result["residual"] = to_numpy(take_column(hit_rows, &HitRow::residual));
    result["err"] = to_numpy(take_column(hit_rows, &HitRow::error));
    result["side"] = to_numpy(take_column(hit_rows, &HitRow::side));
    result["used"] = to_numpy(take_column(hit_rows, &HitRow::used));
  }
  return result;
}

}  // namespace

void bind_fit(py::module_& module) {
  py::class_<FitSettings>(module, "FitSettings",
                          "Settings of the fit; the values live in cgemit.fit.FitSettings.")
      .def(py::init([](int max_iterations, double tolerance, bool errors_from_track, double least_width,
                       double delta_strips, double outlier_pull, const std::array<double, 5>& prior_sigma) {
             return FitSettings{max_iterations, tolerance,    errors_from_track, least_width,
                                delta_strips,   outlier_pull, prior_sigma};
           }),
           py::kw_only(), py::arg("max_iterations"), py::arg("tolerance"), py::arg("errors_from_track"),
           py::arg("least_width"), py::arg("delta_strips"), py::arg("outlier_pull"), py::arg("prior_sigma"));
  module.def("fit", &run, py::arg("detector"), py::kw_only(), py::arg("hit_offsets"), py::arg("hits"),
             py::arg("mass"), py::arg("start"), py::arg("settings"), py::arg("residuals"),
             "Fit one track per row of hit_offsets; columns of the tracks, and of the hits' residuals if "
             "asked for.");
}

#include "fit/fit.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "common/angles.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// Columns of the result, filled track by track.
struct Output {
  std::vector<double> helix, covariance, chi2, residual, error;
  std::vector<std::int32_t> clusters, wires, ndf, iterations;
  std::vector<std::int8_t> status, side;
};

void store(const FitResult& result, const FitSpace& space, bool residuals, Output& out) {
  const Perigee& h = result.helix;
  for (const double value : {h.d, wrap_angle(h.psi - 0.5 * pi), h.kappa, h.z0, h.tanl})
    out.helix.push_back(value);
  for (Eigen::Index i = 0; i < 5; ++i) {
    for (Eigen::Index j = 0; j < 5; ++j)
      out.covariance.push_back(0.5 * (result.covariance(i, j) + result.covariance(j, i)));
  }
  out.chi2.push_back(result.chi2);
  out.clusters.push_back(result.clusters);
  out.wires.push_back(result.wires);
  out.ndf.push_back(result.measurements - 5);
  out.iterations.push_back(result.iterations);
  out.status.push_back(static_cast<std::int8_t>(result.status));
  if (!residuals) return;
  for (const Residual& r : space.residuals) {
    out.residual.push_back(r.residual);
    out.error.push_back(r.error);
    out.side.push_back(r.side);
  }
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
  Output out;
  {
    py::gil_scoped_release release;
    FitSpace space;
    for (std::size_t i = 0; i < n; ++i) {
      const auto first = static_cast<std::size_t>(offsets[i]),
                 count = static_cast<std::size_t>(offsets[i + 1]) - first;
      Perigee start{};
      if (seeded) start = from_bes3(start_array.data() + 5 * i);
      const FitResult result =
          fit_track(detector, std::span(hits).subspan(first, count), side.subspan(first, count), mass[i],
                    seeded ? &start : nullptr, settings, space);
      store(result, space, residuals, out);
    }
  }
  const auto rows = static_cast<py::ssize_t>(n);
  py::dict result;
  result["helix"] = to_numpy(std::move(out.helix), {rows, 5});
  result["cov"] = to_numpy(std::move(out.covariance), {rows, 5, 5});
  result["chi2"] = to_numpy(std::move(out.chi2));
  result["ndf"] = to_numpy(std::move(out.ndf));
  result["n_clusters"] = to_numpy(std::move(out.clusters));
  result["n_wires"] = to_numpy(std::move(out.wires));
  result["iterations"] = to_numpy(std::move(out.iterations));
  result["status"] = to_numpy(std::move(out.status));
  if (residuals) {
    result["residual"] = to_numpy(std::move(out.residual));
    result["err"] = to_numpy(std::move(out.error));
    result["side"] = to_numpy(std::move(out.side));
  }
  return result;
}

}  // namespace

void bind_fit(py::module_& module) {
  py::class_<FitSettings>(module, "FitSettings",
                          "Settings of the fit; the values live in cgemit.fit.FitSettings.")
      .def(py::init([](int max_iterations, double tolerance, bool errors_from_track, double least_width,
                       double delta_strips, const std::array<double, 5>& prior_sigma) {
             return FitSettings{max_iterations, tolerance,    errors_from_track,
                                least_width,    delta_strips, prior_sigma};
           }),
           py::kw_only(), py::arg("max_iterations"), py::arg("tolerance"), py::arg("errors_from_track"),
           py::arg("least_width"), py::arg("delta_strips"), py::arg("prior_sigma"));
  module.def("fit", &run, py::arg("detector"), py::kw_only(), py::arg("hit_offsets"), py::arg("hits"),
             py::arg("mass"), py::arg("start"), py::arg("settings"), py::arg("residuals"),
             "Fit one track per row of hit_offsets; columns of the tracks, and of the hits' residuals if "
             "asked for.");
}

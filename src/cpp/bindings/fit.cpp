#include "fit/fit.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>

#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// Columns of the result, filled block by block.
struct Output {
  std::vector<double> helix, covariance, chi2, reference, prior, residual, error, value, variance;
  std::vector<std::int32_t> clusters, wires, outliers, ndf, iterations;
  std::vector<std::int8_t> status, side;
  std::vector<std::uint8_t> used;

  Output(std::size_t tracks, std::size_t hits) {
    helix.reserve(5 * tracks);
    covariance.reserve(25 * tracks);
    chi2.reserve(tracks);
    for (auto* column : {&clusters, &wires, &outliers, &ndf, &iterations}) column->reserve(tracks);
    status.reserve(tracks);
    residual.reserve(hits);
    error.reserve(hits);
    side.reserve(hits);
    used.reserve(hits);
  }
  void append(const FitRow& row) {
    helix.insert(helix.end(), row.helix.begin(), row.helix.end());
    covariance.insert(covariance.end(), row.covariance.begin(), row.covariance.end());
    chi2.push_back(row.chi2);
    clusters.push_back(row.clusters);
    wires.push_back(row.wires);
    outliers.push_back(row.outliers);
    ndf.push_back(row.clusters + row.wires - 5);
    iterations.push_back(row.iterations);
    status.push_back(static_cast<std::int8_t>(row.status));
  }
  // What the last iteration was made with, for those who go on from there.
  void append_reference(const FitRow& row) {
    reference.insert(reference.end(), row.reference.begin(), row.reference.end());
    prior.insert(prior.end(), row.prior.begin(), row.prior.end());
  }
  void append(const HitRow& row) {
    residual.push_back(row.residual);
    error.push_back(row.error);
    side.push_back(row.side);
    used.push_back(row.used);
    value.push_back(row.value);
    variance.push_back(row.variance);
  }
  py::dict columns(bool residuals) {
    const auto n = static_cast<py::ssize_t>(chi2.size());
    py::dict out;
    out["helix"] = to_numpy(std::move(helix), {n, 5});
    out["cov"] = to_numpy(std::move(covariance), {n, 5, 5});
    out["chi2"] = to_numpy(std::move(chi2));
    out["ndf"] = to_numpy(std::move(ndf));
    out["n_clusters"] = to_numpy(std::move(clusters));
    out["n_wires"] = to_numpy(std::move(wires));
    out["n_outliers"] = to_numpy(std::move(outliers));
    out["iterations"] = to_numpy(std::move(iterations));
    out["status"] = to_numpy(std::move(status));
    if (!residuals) return out;
    out["reference"] = to_numpy(std::move(reference), {n, 5});
    out["prior"] = to_numpy(std::move(prior), {n, 25});
    out["residual"] = to_numpy(std::move(residual));
    out["err"] = to_numpy(std::move(error));
    out["side"] = to_numpy(std::move(side));
    out["used"] = to_numpy(std::move(used));
    out["used_value"] = to_numpy(std::move(value));
    out["used_variance"] = to_numpy(std::move(variance));
    return out;
  }
};

// Tracks whose hits stay in the processor's cache while they are fitted.
constexpr std::size_t block_of_tracks = 256;

py::dict run(const Detector& detector, const Array<std::int64_t>& hit_offsets, const py::dict& hit_columns,
             const Array<double>& mass_array, const Array<double>& start_array, const FitSettings& settings,
             bool residuals) {
  const auto offsets = column(hit_offsets, "hit_offsets");
  if (offsets.empty()) throw std::invalid_argument("hit_offsets: expected at least one entry");
  const auto n = offsets.size() - 1;
  if (offsets[0] != 0) throw std::invalid_argument("hit_offsets: expected to begin with 0");
  for (std::size_t i = 0; i < n; ++i) {
    if (offsets[i] > offsets[i + 1]) throw std::invalid_argument("hit_offsets: expected to increase");
  }
  const auto n_hits = static_cast<py::ssize_t>(offsets[n]);
  const auto mass = column(mass_array, "mass", static_cast<py::ssize_t>(n));
  const bool seeded = start_array.ndim() == 2 && start_array.shape(0) > 0;
  if (seeded) matrix(start_array, "start", static_cast<py::ssize_t>(n), 5);
  const auto side_array = take<std::int8_t>(hit_columns, "side");
  const auto side = column(side_array, "side", n_hits);
  const HitColumns columns(detector, hit_columns, n_hits);
  std::vector<Perigee> start;
  for (std::size_t i = 0; seeded && i < n; ++i) start.push_back(from_bes3(start_array.data() + 5 * i));
  Output out(n, residuals ? static_cast<std::size_t>(n_hits) : 0);
  // A field map is stepped through one track at a time.
  const auto fit = detector.field.is_uniform() ? kernels().fit : &fit_tracks;
  {
    py::gil_scoped_release release;
    std::vector<Hit> hits;
    std::vector<FitRow> rows;
    std::vector<HitRow> hit_rows;
    for (std::size_t begin = 0; begin < n; begin += block_of_tracks) {
      const std::size_t tracks = std::min(block_of_tracks, n - begin);
      const auto first = static_cast<std::size_t>(offsets[begin]),
                 last = static_cast<std::size_t>(offsets[begin + tracks]);
      columns.take(first, last - first, hits);
      rows.resize(tracks);
      hit_rows.resize(residuals ? last - first : 0);
      const FitInput input{
          offsets.subspan(begin, tracks + 1), hits, side.subspan(first, last - first),
          mass.subspan(begin, tracks),
          seeded ? std::span<const Perigee>(start).subspan(begin, tracks) : std::span<const Perigee>()};
      fit(detector, input, settings, {rows.data(), residuals ? hit_rows.data() : nullptr});
      for (const FitRow& row : rows) {
        out.append(row);
        if (residuals) out.append_reference(row);
      }
      for (const HitRow& row : hit_rows) out.append(row);
    }
  }
  return out.columns(residuals);
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

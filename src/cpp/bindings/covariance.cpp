#include "covariance/covariance.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bindings/arrays.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// The rows of one track as numpy columns.
py::dict columns_of(const std::vector<CovarianceRow>& rows) {
  Filled<double> covariance(rows.size(), {static_cast<py::ssize_t>(covariance_entries)});
  Filled<std::int32_t> clusters(rows.size()), wires(rows.size());
  Filled<std::int8_t> status(rows.size());
  for (const CovarianceRow& row : rows) {
    covariance.append(row.covariance);
    clusters.append(row.clusters);
    wires.append(row.wires);
    status.append(static_cast<std::int8_t>(row.status));
  }
  py::dict out;
  out["covariance"] = covariance.array();
  out["n_clusters"] = clusters.array();
  out["n_wires"] = wires.array();
  out["status"] = status.array();
  return out;
}

// The expected hits of all tracks as numpy columns, as a fit takes them.
py::dict columns_of(const std::vector<ExpectedHit>& hits, const Detector& detector) {
  Filled<std::uint8_t> kind(hits.size());
  Filled<std::int32_t> layer(hits.size()), channel(hits.size());
  Filled<double> value(hits.size()), variance(hits.size()), k(hits.size()), x(hits.size());
  for (const ExpectedHit& hit : hits) {
    const bool wire = hit.view == View::wire;
    kind.append(static_cast<std::uint8_t>(hit.view));
    layer.append(wire ? detector.wires[static_cast<std::size_t>(hit.layer)].number : hit.layer);
    channel.append(hit.channel);
    value.append(hit.value);
    variance.append(hit.variance);
    k.append(hit.k);
    x.append(hit.x);
  }
  py::dict out;
  out["kind"] = kind.array();
  out["layer"] = layer.array();
  out["channel"] = channel.array();
  out["value"] = value.array();
  out["variance"] = variance.array();
  out["k"] = k.array();
  out["x"] = x.array();
  return out;
}

py::dict run(const Detector& detector, const Array<double>& phi, const Array<double>& kappa,
             const Array<double>& tanl, const Array<double>& mass, const Array<double>& scatters,
             std::size_t samples, const Array<double>& phases, const HitModel& model, bool budget, bool hits,
             const std::vector<const Detector*>& variants) {
  const auto n = phi.size();
  const auto views = static_cast<py::ssize_t>(2 * detector.cgem.size());
  if (samples == 0 || n % static_cast<py::ssize_t>(samples) != 0)
    throw std::invalid_argument("samples: expected a divisor of the number of tracks");
  for (const auto* number : {&model.sigma_x, &model.sigma_v, &model.corr_xv})
    if (model.cos_theta.empty() || number->size() != detector.cgem.size() * model.cos_theta.size())
      throw std::invalid_argument(
          "sigma_x, sigma_v, corr_xv: expected a number for each CGEM layer and cos_theta");
  for (const Detector* variant : variants)
    if (variant == nullptr || !same_surfaces(detector, *variant))
      throw std::invalid_argument("variants: expected the surfaces of the detector in the same order");
  std::vector<double> psi;
  for (const double azimuth : column(phi, "phi", n)) psi.push_back(azimuth);
  const CovarianceInput input{.psi = psi,
                              .kappa = column(kappa, "kappa", n),
                              .tanl = column(tanl, "tanl", n),
                              .mass = column(mass, "mass", n),
                              .scatters = column(scatters, "scatters", n),
                              .samples = samples,
                              .phases = matrix(phases, "phases", static_cast<py::ssize_t>(samples), views),
                              .variants = variants};
  const BudgetTerms names(detector);
  std::vector<CovarianceRow> rows(static_cast<std::size_t>(n) * (1 + variants.size()));
  const std::size_t points = static_cast<std::size_t>(n) / samples;
  std::vector<double> sums(budget ? points * names.size() * budget_entries : 0, 0.0);
  std::vector<ExpectedHit> expected;
  static_assert(sizeof(BudgetTerm) == budget_entries * sizeof(double));
  {
    py::gil_scoped_release release;
    kernels().covariances(detector, input, model,
                          {rows.data(), budget ? reinterpret_cast<BudgetTerm*>(sums.data()) : nullptr,
                           hits ? &expected : nullptr});
  }
  py::dict out = columns_of(rows);
  if (hits) out["hits"] = columns_of(expected, detector);
  if (budget)
    out["budget"] =
        to_numpy(std::move(sums), {static_cast<py::ssize_t>(points), static_cast<py::ssize_t>(names.size()),
                                   static_cast<py::ssize_t>(budget_entries)});
  return out;
}

}  // namespace

void bind_covariance(py::module_& module) {
  module.def("same_surfaces", &same_surfaces, py::arg("detector"), py::arg("other"),
             "Whether the surfaces of two detectors have the same order, so that one can be a variant of the "
             "other in `covariances`.");
  py::class_<HitModel>(module, "HitModel",
                       "Errors of the hits that cgemit.covariance expects, and the prior of the filter.")
      .def(
          py::init([](std::vector<double> cos_theta, std::vector<double> sigma_x, std::vector<double> sigma_v,
                      std::vector<double> corr_xv, double least_width, double delta_strips, bool sides_known,
                      std::uint64_t seed, const std::array<double, 5>& prior_sigma) {
            return HitModel{.cos_theta = std::move(cos_theta),
                            .sigma_x = std::move(sigma_x),
                            .sigma_v = std::move(sigma_v),
                            .corr_xv = std::move(corr_xv),
                            .least_width = least_width,
                            .delta_strips = delta_strips,
                            .sides_known = sides_known,
                            .seed = seed,
                            .prior_sigma = prior_sigma};
          }),
          py::kw_only(), py::arg("cos_theta"), py::arg("sigma_x"), py::arg("sigma_v"), py::arg("corr_xv"),
          py::arg("least_width"), py::arg("delta_strips"), py::arg("sides_known"), py::arg("seed"),
          py::arg("prior_sigma"));
  module.def(
      "covariances", &run, py::arg("detector"), py::kw_only(), py::arg("phi"), py::arg("kappa"),
      py::arg("tanl"), py::arg("mass"), py::arg("scatters"), py::arg("samples"), py::arg("phases"),
      py::arg("model"), py::arg("budget"), py::arg("hits") = false,
      py::arg("variants") = std::vector<const Detector*>(),
      "Covariances of (dr, phi0, kappa, dz, tanl) of tracks from the origin, without events: columns of "
      "the tracks, and if requested the sums of the budget's terms over the samples of each point, and the "
      "expected hits of all tracks (X, V - k x, or signed distance from a wire, mm; variance, mm2). Rows of "
      "`variants` of the detector, which keep the hits of the first one, follow those of the detector.");
}

#include "covariance/covariance.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bindings/hits.hpp"
#include "bindings/interrupt.hpp"
#include "bindings/settings.hpp"
#include "common/angles.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

HitModel hit_model(const py::dict& values) {
  Settings in("model", values);
  HitModel model{.cos_theta = in["cos_theta"],
                 .sigma_x = in["sigma_x"],
                 .sigma_v = in["sigma_v"],
                 .corr_xv = in["corr_xv"],
                 .least_width = in["least_width"],
                 .delta_strips = in["delta_strips"],
                 .sides_known = in["sides_known"],
                 .seed = in["seed"],
                 .prior_sigma = in["prior_sigma"]};
  in.check();
  return model;
}

py::dict run_covariances(const Detector& detector, const Array<double>& phi, const Array<double>& kappa,
                         const Array<double>& tanl, const Array<double>& mass,
                         const Array<double>& charge_array, const Array<double>& scatters,
                         std::size_t samples, const Array<double>& phases, const Array<double>& efficiencies,
                         const py::dict& model_values, bool budget, bool hits,
                         const std::vector<const Detector*>& variants, bool scalar, const Array<double>& dr,
                         const Array<double>& dz) {
  const HitModel model = hit_model(model_values);
  const auto n = phi.size();
  const std::vector<double> charge = charges(charge_array, n);
  const auto views = static_cast<py::ssize_t>(2 * detector.layers.size());
  if (samples == 0 || n % static_cast<py::ssize_t>(samples) != 0)
    throw std::invalid_argument("samples: expected a divisor of the number of tracks");
  for (const auto* number : {&model.sigma_x, &model.sigma_v, &model.corr_xv})
    if (model.cos_theta.empty() || number->size() != detector.layers.size() * model.cos_theta.size())
      throw std::invalid_argument(
          "sigma_x, sigma_v, corr_xv: expected a number for each CGEM layer and cos_theta");
  for (const Detector* variant : variants)
    if (variant == nullptr || !same_surfaces(detector, *variant))
      throw std::invalid_argument("variants: expected the surfaces of the detector in the same order");
  if ((dr.size() == 0) != (dz.size() == 0)) throw std::invalid_argument("dr, dz: expected both or none");
  // Cells are counted from azimuths of about a turn.
  std::vector<double> psi;
  for (const double azimuth : column(phi, "phi", n))
    psi.push_back(std::abs(azimuth) <= 2 * pi ? azimuth : wrap_angle(azimuth));
  const CovarianceInput input{.psi = psi,
                              .kappa = column(kappa, "kappa", n),
                              .tanl = column(tanl, "tanl", n),
                              .mass = column(mass, "mass", n),
                              .charge = charge,
                              .scatters = column(scatters, "scatters", n),
                              .samples = samples,
                              .phases = matrix(phases, "phases", static_cast<py::ssize_t>(samples), views),
                              .efficiencies = efficiencies.size() == 0
                                                  ? std::span<const double>()
                                                  : matrix(efficiencies, "efficiencies", n, views / 2),
                              .d = dr.size() == 0 ? std::span<const double>() : column(dr, "dr", n),
                              .z0 = dz.size() == 0 ? std::span<const double>() : column(dz, "dz", n),
                              .variants = variants,
                              .interrupted = interrupted};
  const BudgetTerms names(detector);
  std::vector<CovarianceRow> rows(static_cast<std::size_t>(n) * (1 + variants.size()));
  const std::size_t points = static_cast<std::size_t>(n) / samples;
  std::vector<double> sums(budget ? points * names.size() * budget_entries : 0, 0.0);
  Columns<ExpectedHit> expected;
  static_assert(sizeof(BudgetTerm) == budget_entries * sizeof(double));
  {
    py::gil_scoped_release release;
    const Kernels& used = scalar ? scalar_kernels() : kernels();
    used.covariances(detector, input, model,
                     {rows.data(), budget ? reinterpret_cast<BudgetTerm*>(sums.data()) : nullptr,
                      hits ? &expected : nullptr});
  }
  throw_if_interrupted();
  Columns<CovarianceRow> of_track;
  of_track.append(rows);
  py::dict out = to_dict(std::move(of_track));
  if (hits) out["hits"] = to_dict(std::move(expected));
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
  module.def(
      "covariances", &run_covariances, py::arg("detector"), py::kw_only(), py::arg("phi"), py::arg("kappa"),
      py::arg("tanl"), py::arg("mass"), py::arg_v("charge", Array<double>(0), "..."), py::arg("scatters"),
      py::arg("samples"), py::arg("phases"), py::arg_v("efficiencies", Array<double>(0), "..."),
      py::arg("model"), py::arg("budget"), py::arg("hits") = false,
      py::arg("variants") = std::vector<const Detector*>(), py::arg("scalar") = false,
      py::arg_v("dr", Array<double>(0), "..."), py::arg_v("dz", Array<double>(0), "..."),
      "Covariances of (dr, phi0, kappa, dz, tanl) of tracks from the origin, or `dr` and `dz` (mm) beside "
      "it, "
      "without events: columns of "
      "the tracks, and if requested the sums of the budget's terms over the samples of each point, and the "
      "expected hits of all tracks (X, V - k x, or signed distance from a wire, mm; variance, mm2). Rows of "
      "`variants` of the detector, which keep the hits of the first one, follow those of the detector. The "
      "budget is that of the last one. `scalar`: with the scalar kernels, whichever are in use.");
}

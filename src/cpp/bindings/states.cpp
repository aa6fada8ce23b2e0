#include "reconstruction/fit/states.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <tuple>

#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "bindings/interrupt.hpp"
#include "common/angles.hpp"
#include "common/problems.hpp"
#include "detector/start_radius.hpp"
#include "kalman/group.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

template <std::size_t N>
constexpr std::array<double, N> filled(double value) {
  std::array<double, N> found{};
  found.fill(value);
  return found;
}

// Missing values are NaN.
struct StateRow {
  StateStatus status;
  std::int64_t track, target, hit;
  std::array<double, 3> pivot = filled<3>(nan);
  std::array<double, 5> helix = filled<5>(nan);
  std::array<std::array<double, 5>, 5> covariance = {helix, helix, helix, helix, helix};
  double residual = nan, error = nan;

  static constexpr auto columns() {
    return std::tuple(Column("status", &StateRow::status), Column("track", &StateRow::track),
                      Column("target", &StateRow::target), Column("hit", &StateRow::hit),
                      Column("pivot", &StateRow::pivot), Column("helix", &StateRow::helix),
                      Column("cov", &StateRow::covariance), Column("residual", &StateRow::residual),
                      Column("err", &StateRow::error));
  }
};

StateRow row_of(const TrackState& found, std::size_t track, std::size_t target, std::int64_t hit) {
  StateRow row{.status = found.status,
               .track = static_cast<std::int64_t>(track),
               .target = static_cast<std::int64_t>(target),
               .hit = hit};
  if (found.status != StateStatus::ok) return row;
  const LocalState& s = found.state;
  const Perigee& h = s.helix;
  row.pivot = {s.x, s.y, s.z};
  row.helix = {h.d, wrap_angle(h.psi - 0.5 * pi), h.kappa, h.z0, h.tanl};
  for (Eigen::Index i = 0; i < 5; ++i) {
    for (Eigen::Index j = 0; j < 5; ++j)
      row.covariance[static_cast<std::size_t>(i)][static_cast<std::size_t>(j)] =
          0.5 * (s.c(i, j) + s.c(j, i));
  }
  if (!(found.variance > 0)) return row;
  row.residual = found.residual;
  row.error = std::sqrt(found.variance);
  return row;
}

std::vector<Target> targets_of(const py::dict& columns) {
  auto targets = Inputs(columns, "targets").read_rows<Target>();
  for (const Target& target : targets) {
    if (target.surface < StateSurface::origin || target.surface > StateSurface::hit)
      throw std::invalid_argument("surface: no such surface");
    const bool at_radius = target.surface == StateSurface::cylinder;
    if (!(target.radius >= 0 && target.radius < HUGE_VAL) || (at_radius && target.radius == 0))
      throw std::invalid_argument("radius: expected a finite length, above 0 for a cylinder");
    if (!(target.share >= 0 && target.share <= 1)) throw std::invalid_argument("share: expected 0 to 1");
  }
  return targets;
}

// Rows of one track, in the order of the targets. Their number does not depend on the status of the fit.
void add_track(const std::vector<TrackState>& found, const std::vector<Target>& targets, std::size_t track,
               std::size_t first_hit, std::size_t hits, Columns<StateRow>& out) {
  std::size_t row = 0;
  for (std::size_t k = 0; k < targets.size(); ++k) {
    const bool at_hits = targets[k].surface == StateSurface::hit;
    for (std::size_t i = 0; i < (at_hits ? hits : 1); ++i) {
      const TrackState lost{StateStatus::not_fitted, -1, {}, 0, 0};
      out.push_back(row_of(found.empty() ? lost : found[row++], track, k,
                           at_hits ? static_cast<std::int64_t>(first_hit + i) : -1));
    }
  }
}

bool all_finite(std::span<const double> values) {
  return std::ranges::all_of(values, [](double value) { return std::isfinite(value); });
}

// Throws unless the numbers of all fitted tracks can be propagated.
void check_tracks(std::span<const std::uint8_t> fitted, std::span<const double> reference,
                  std::span<const double> kinks, std::span<const double> prior, std::span<const double> mass,
                  std::size_t angles) {
  Problems problems;
  for (std::size_t i = 0; i < fitted.size(); ++i) {
    if (!fitted[i]) continue;
    const bool finite = all_finite(reference.subspan(5 * i, 5)) && all_finite(prior.subspan(25 * i, 25)) &&
                        all_finite(kinks.subspan(angles * i, angles)) && std::isfinite(mass[i]);
    if (!finite || reference[5 * i + 2] == 0 || !(mass[i] > 0))
      problems.add("track " + std::to_string(i) +
                   ": expected finite reference, kinks and prior, kappa other than 0, and a mass above 0");
  }
  problems.raise("states");
}

// Momenta with which tracks scatter and lose energy, 0 for that of kappa; none: that of kappa for all.
std::vector<double> momenta_in_matter(const Array<double>& given, py::ssize_t n) {
  if (given.size() == 0) return std::vector<double>(static_cast<std::size_t>(n), 0.0);
  const auto momenta = column(given, "matter_p", n);
  if (!std::ranges::all_of(momenta, [](double p) { return p >= 0 && p < HUGE_VAL; }))
    throw std::invalid_argument("matter_p: expected finite numbers, 0 or more");
  return {momenta.begin(), momenta.end()};
}

py::dict run_states(const Detector& detector, const Array<std::int64_t>& hit_offsets,
                    const py::dict& hit_columns, const Array<double>& reference_array,
                    const Array<double>& kinks_array, const Array<double>& prior_array,
                    const Array<double>& mass_array, const Array<double>& charge_array,
                    const Array<double>& matter_p_array, const Array<double>& start_radius,
                    const Array<std::uint8_t>& fitted_array, const py::dict& target_columns) {
  const auto offsets = hit_offsets_of(hit_offsets);
  const auto n = static_cast<py::ssize_t>(offsets.size()) - 1;
  const auto n_hits = static_cast<py::ssize_t>(offsets.back());
  const auto reference = matrix(reference_array, "reference", n, 5);
  const std::size_t angles = 2 * detector.slabs.size();
  const auto kinks = matrix(kinks_array, "kinks", n, static_cast<py::ssize_t>(angles));
  const auto prior = matrix(prior_array, "prior", n, 25);
  const auto mass = column(mass_array, "mass", n);
  const std::vector<double> charge = charges(charge_array, n);
  const std::vector<double> matter_p = momenta_in_matter(matter_p_array, n);
  const auto fitted = column(fitted_array, "fitted", n);
  const StartRadii begins(detector, mass.size(), start_radii(start_radius, n));
  check_tracks(fitted, reference, kinks, prior, mass, angles);
  const std::vector<UsedHit> used = used_hits(hit_columns, n_hits);
  std::vector<Hit> hits;
  HitColumns(detector, hit_columns, n_hits).take(0, static_cast<std::size_t>(n_hits), hits);
  const std::vector<Target> targets = targets_of(target_columns);
  Columns<StateRow> out;
  {
    py::gil_scoped_release release;
    StateSpace space;
    std::vector<TrackState> found;
    for (std::size_t i = 0; i < mass.size() && !interrupted(); ++i) {
      const auto first = static_cast<std::size_t>(offsets[i]),
                 count = static_cast<std::size_t>(offsets[i + 1]) - first;
      const double* r = reference.data() + 5 * i;
      const FittedTrack track{std::span(hits).subspan(first, count),
                              std::span(used).subspan(first, count),
                              {r[0], r[1], r[2], r[3], r[4]},
                              std::span(kinks).subspan(angles * i, angles),
                              Eigen::Map<const Matrix5>(prior.data() + 25 * i),
                              mass[i],
                              charge[i],
                              matter_p[i]};
      found.clear();
      if (fitted[i]) fitted_states(begins.of(i), track, targets, space, found);
      add_track(found, targets, i, first, count, out);
    }
  }
  throw_if_interrupted();
  return to_dict(std::move(out));
}

LocalState load(const double* pivot, const double* helix, const double* covariance) {
  return {pivot[0], pivot[1], pivot[2], from_bes3(helix),
          Eigen::Map<const Eigen::Matrix<double, 5, 5, Eigen::RowMajor>>(covariance)};
}

py::dict run_extrapolate(const Detector& detector, const Array<double>& pivot_array,
                         const Array<double>& helix_array, const Array<double>& covariance_array,
                         const Array<double>& mass_array, const Array<double>& charge_array,
                         const Array<double>& matter_p_array, double radius, const Array<double>& from_array,
                         double to) {
  const auto mass = column(mass_array, "mass");
  const auto n = static_cast<py::ssize_t>(mass.size());
  const auto pivot = matrix(pivot_array, "pivot", n, 3), helix = matrix(helix_array, "helix", n, 5),
             covariance = matrix(covariance_array, "cov", n, 25);
  const auto from = column(from_array, "share", n);
  const std::vector<double> charge = charges(charge_array, n);
  const std::vector<double> matter_p = momenta_in_matter(matter_p_array, n);
  if (!(radius > 0 && radius < HUGE_VAL))
    throw std::invalid_argument("radius: expected a finite length above 0");
  Columns<StateRow> out;
  {
    py::gil_scoped_release release;
    for (std::size_t i = 0; i < mass.size() && !interrupted(); ++i) {
      TrackState found{StateStatus::not_fitted, -1, {}, 0, 0};
      found.state = load(pivot.data() + 3 * i, helix.data() + 5 * i, covariance.data() + 25 * i);
      found.state.matter_p = matter_p[i];
      if (found.state.c.allFinite() && std::isfinite(mass[i]) && found.state.helix.kappa != 0)
        found.status = extrapolate(detector, found.state, mass[i], charge[i], radius, from[i], to);
      out.push_back(row_of(found, i, 0, -1));
    }
  }
  throw_if_interrupted();
  return to_dict(std::move(out));
}

py::array_t<double> matter_momenta(const Array<double>& kappa_array, const Array<double>& sigma_array,
                                   const Array<double>& tanl_array, const Array<double>& charge_array,
                                   double momentum, double bz) {
  const auto kappa = column(kappa_array, "kappa");
  const auto n = static_cast<py::ssize_t>(kappa.size());
  const auto sigma = column(sigma_array, "sigma", n), tanl = column(tanl_array, "tanl", n);
  const std::vector<double> charge = charges(charge_array, n);
  if (!(momentum > 0 && momentum < HUGE_VAL))
    throw std::invalid_argument("momentum: expected a finite number above 0");
  std::vector<double> found;
  for (std::size_t i = 0; i < kappa.size(); ++i) {
    const double charge_sec = charge[i] * std::sqrt(1 + tanl[i] * tanl[i]);
    const auto matter = MatterMomentum<double>::of_fit(kappa[i], sigma[i], charge_sec, momentum, bz);
    found.push_back(matter.given && std::isfinite(matter.p) ? matter.p : 0);
  }
  return to_numpy(std::move(found));
}

py::tuple run_change_pivot(const Array<double>& helix_array, const Array<double>& covariance_array,
                           const Array<double>& step_array, const Array<double>& bz_array) {
  const py::ssize_t n = helix_array.ndim() == 2 ? helix_array.shape(0) : 0;
  const auto helix = matrix(helix_array, "helix", n, 5), covariance = matrix(covariance_array, "cov", n, 25),
             step = matrix(step_array, "step", n, 3);
  const auto bz = column(bz_array, "bz", n);
  const double origin[3] = {0, 0, 0};
  Columns<StateRow> out;
  for (py::ssize_t i = 0; i < n; ++i) {
    TrackState found{StateStatus::ok, -1, load(origin, helix.data() + 5 * i, covariance.data() + 25 * i), 0,
                     0};
    const double* to = step.data() + 3 * i;
    const double per_kappa = curvature(bz[static_cast<std::size_t>(i)], 1.0);
    if (!change_pivot(found.state, to[0], to[1], to[2], per_kappa)) found.status = StateStatus::not_fitted;
    out.push_back(row_of(found, static_cast<std::size_t>(i), 0, -1));
  }
  const py::dict columns = to_dict(std::move(out));
  return py::make_tuple(columns["helix"], columns["cov"]);
}

}  // namespace

void bind_states(py::module_& module) {
  py::native_enum<StateSurface>(module, "Surface", "enum.IntEnum", "Where a fitted track has a state.")
      .value("origin", StateSurface::origin)
      .value("beam_line", StateSurface::beam_line)
      .value("cylinder", StateSurface::cylinder)
      .value("hit", StateSurface::hit)
      .finalize();
  module.def("states", &run_states, py::arg("detector"), py::kw_only(), py::arg("hit_offsets"),
             py::arg("hits"), py::arg("reference"), py::arg("kinks"), py::arg("prior"), py::arg("mass"),
             py::arg_v("charge", Array<double>(0), "..."), py::arg_v("matter_p", Array<double>(0), "..."),
             py::arg_v("start_radius", Array<double>(0), "..."), py::arg("fitted"), py::arg("targets"),
             "Smoothed states of fitted tracks at every target.");
  module.def("extrapolate", &run_extrapolate, py::arg("detector"), py::kw_only(), py::arg("pivot"),
             py::arg("helix"), py::arg("cov"), py::arg("mass"), py::arg_v("charge", Array<double>(0), "..."),
             py::arg_v("matter_p", Array<double>(0), "..."), py::arg("radius"), py::arg("share"),
             py::arg("target_share"), "Move states to a cylinder through the matter on the trajectory.");
  module.def(
      "matter_momenta", &matter_momenta, py::kw_only(), py::arg("kappa"), py::arg("sigma"), py::arg("tanl"),
      py::arg_v("charge", Array<double>(0), "..."), py::arg("momentum"), py::arg("bz"),
      "Momenta, GeV/c, with which tracks scatter and lose energy whose fitted kappa has an error `sigma` "
      "in a field of bz: 0 where kappa measures it, else the given one, or a larger one if kappa "
      "excludes it.");
}

void bind_helices(py::module_& module) {
  module.attr("STRAIGHT_FIELD") = straight_field;
  module.def("change_pivot", &run_change_pivot, py::arg("helix"), py::arg("cov"), py::arg("step"),
             py::arg("bz"),
             "Helices and covariances (n, 25) at pivots moved by steps (n, 3), in fields (n,).");
}

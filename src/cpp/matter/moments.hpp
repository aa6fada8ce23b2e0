// What a slab does to a charged particle: the moments that the fit uses and that the simulation samples.
//
// Highland's and Landau's widths are not additive: cut a slab in two and the sum differs. Both are therefore
// taken once for the whole track (`TrackMatter`) and shared out in proportion, so that nothing depends on how
// matter is cut.
#pragma once

#include <algorithm>
#include <cmath>

#include "common/units.hpp"
#include "detector/detector.hpp"

namespace cgemit {

// Below this kinetic energy a particle counts as stopped.
inline constexpr double least_kinetic = 0.1 * MeV;

// Kinematics of a particle at one momentum. Momenta in GeV/c, energies in GeV.
struct Kinematics {
  double p, energy, mass;
  double per_mass, per_beta2, beta2, gamma;
  double log_bg, log_gamma;  // ln(beta gamma), ln(gamma)

  Kinematics(double momentum, double mass_) : p(momentum), mass(mass_), per_mass(1 / mass_) {
    follow_from_p();
    log_bg = std::log(p * per_mass);
    log_gamma = std::log(gamma);
  }
  // The same particle at another momentum. Small changes, as in a thin slab, need no logarithm.
  Kinematics at(double momentum) const {
    Kinematics k = *this;
    k.p = momentum;
    k.follow_from_p();
    k.log_bg += log_ratio(momentum, p);
    k.log_gamma += log_ratio(k.energy, energy);
    return k;
  }
  double log_beta2() const { return 2 * (log_bg - log_gamma); }
  // Largest energy that one collision can give to an electron at rest; PDG 2024 eq. 34.4.
  double w_max() const {
    const double ratio = electron_mass * per_mass, bg = p * per_mass;
    return 2 * electron_mass * bg * bg / (1 + 2 * gamma * ratio + ratio * ratio);
  }

 private:
  void follow_from_p() {
    energy = std::sqrt(p * p + mass * mass);
    const double per_beta = energy / p;
    per_beta2 = per_beta * per_beta;
    beta2 = 1 / per_beta2;
    gamma = energy * per_mass;
  }
  // ln(a/b), by its series where the next term is below 1e-9.
  static double log_ratio(double a, double b) {
    const double d = (a - b) / b;
    return std::abs(d) < 0.02 ? d * (1 - d * (1.0 / 2 - d * (1.0 / 3 - d / 4))) : std::log(a / b);
  }
};

// What a track crosses in all.
struct TrackMatter {
  double x0;  // path in radiation lengths
  double xi;  // GeV, Landau's xi times beta^2
  double log_x0, log_xi;

  TrackMatter(double x0_, double xi_) : x0(x0_), xi(xi_), log_x0(std::log(x0_)), log_xi(std::log(xi_)) {}
};

// Factor by which a track sees a slab thicker than at normal incidence: `stretch` = 1/cos(lambda), times
// 1/cos(a), cos(a) = P/r. A grazing track sees at most the chord of the shell.
inline double path_factor(const Slab& slab, double stretch, double outward) {
  return stretch * slab.radius / std::max(outward, slab.least_outward);
}

// Thickness of the detector along a straight line from the origin with this slope.
TrackMatter total_matter(const Detector& detector, double tanl);

// Plane multiple-scattering angle squared: Highland in the form of Lynch and Dahl, PDG 2024 eq. 34.16, with
// the logarithm of the whole track. 11 % over all elements for 1e-3 < x0 < 100. 1/(beta p) is the mean
// (geometric) of that before and after the slab.
inline double scattering_variance(const Kinematics& before, const Kinematics& after, double x0,
                                  const TrackMatter& track) {
  const double log_factor = std::max(1 + 0.038 * (track.log_x0 - before.log_beta2()), 0.0);
  const double scale = 13.6 * MeV * log_factor;
  const double momenta = before.p * after.p;
  return scale * scale * x0 * before.energy * after.energy / (momenta * momenta);
}

// -2 ln(I) - delta of a slab, and its slope in ln(beta gamma).
struct LogTerm {
  double value, slope;
};
inline LogTerm log_term(const Slab& slab, double log_bg) {
  const double position = (log_bg - loss_grid_first) / loss_grid_step;
  const int bin = std::clamp(static_cast<int>(position), 0, loss_points - 2);
  const auto i = static_cast<std::size_t>(bin);
  const double slope = slab.log_term[i + 1] - slab.log_term[i];
  return {slab.log_term[i] + slope * (position - bin), slope / loss_grid_step};
}

// Mean energy loss by collisions with a transfer below `cut`; PDG 2024 eqs. 34.5 and 34.11 (all transfers for
// cut >= w_max), heavy particles; no shell correction, so beta gamma > 0.3.
inline double restricted_loss(const Slab& slab, double path, const Kinematics& k, double cut) {
  const double w_max = k.w_max();
  const double limit = std::min(cut, w_max);
  const double bg = k.p * k.per_mass;
  const double bracket = std::log(2 * electron_mass * bg * bg * limit) - k.beta2 * (1 + limit / w_max) +
                         log_term(slab, k.log_bg).value;
  return std::max(slab.xi * path * k.per_beta2 * bracket, 0.0);
}

// The energy loss that the fit subtracts, and its variance.
struct LossMoments {
  double loss;      // GeV
  double variance;  // GeV^2
  double slope;     // d(loss)/d(p), GeV per GeV/c
};

// Landau's distribution has no variance, and rare collisions dominate its mean. The fit describes the core:
// mean and variance of all collisions with a transfer below `core_cut` times the track's xi. Harder ones,
// xi/cut of them per track, happen to one track in ten and are left to the tail. The cut is the track's, so
// the moments of slabs add up. Slow particles (cut above w_max) get Bethe's mean and Vavilov's variance.
inline constexpr double core_cut = 10;

LossMoments core_loss(const Slab& slab, double path, const Kinematics& k, const TrackMatter& track);

}  // namespace cgemit

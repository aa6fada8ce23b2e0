#include "matter/loss.hpp"

#include <algorithm>

#include "matter/radiation.hpp"

namespace cgemit {

namespace {

// -2 ln(I) - delta - 2 C/Z of a slab, and its slope in ln(beta gamma).
Read<double> log_term(const Slab& slab, double log_bg) { return read<&SlabPoint::log_term>(slab, log_bg); }

// The bracket multiplied by xi/beta^2, for electrons and positrons: F-(tau, D) and F+(tau, D) of Berger and
// Seltzer, energies in m_e.
double light_bracket(const Slab& slab, const Kinematics& k, double limit) {
  const double tau = k.kinetic() / electron_mass, d = std::min(limit / electron_mass, 0.999999 * tau);
  double f = 0;
  if (k.projectile == Projectile::electron) {
    f = -1 - k.beta2 + std::log((tau - d) * d) + tau / (tau - d) +
        (0.5 * d * d + (2 * tau + 1) * std::log1p(-d / tau)) / (k.gamma * k.gamma);
  } else {
    const double y = 1 / (k.gamma + 1), d2 = d * d, d3 = d2 * d;
    f = std::log(tau * d) - k.beta2 / tau *
                                (tau + 2 * d - 1.5 * d2 * y - (d - d3 / 3) * y * y -
                                 (0.5 * d2 - tau * d3 / 3 + 0.25 * d2 * d2) * y * y * y);
  }
  return f + std::log(2 * (k.gamma + 1) * electron_mass * electron_mass) + log_term(slab, k.log_bg).value;
}

}  // namespace

void prepare_loss(Detector& detector, CoreLoss choice, bool radiation, double momentum_error) {
  constexpr double everything = 1e30, most_probable = 0.2, half_maximum = 4.018 / 2.3548;
  LossCuts& cuts = detector.loss;
  switch (choice) {
    case CoreLoss::truncated:
      cuts = {core_cut_xi, core_cut_xi, core_cut_share(momentum_error)};
      break;
    case CoreLoss::mean:
      cuts = {everything, everything, 0};
      break;
    case CoreLoss::most_probable:
      cuts = {std::exp(most_probable), half_maximum * half_maximum, 0};
      break;
  }
  cuts.radiation = radiation ? 1 : 0;
}

double light_spectrum_share(const Kinematics& k, double transfer) {
  const double e = transfer / k.kinetic();
  if (k.projectile == Projectile::electron) {  // Moller; ICRU Report 37, eq. 2.5
    const double other = e / (1 - e), tau = (k.gamma - 1) / k.gamma;
    return 1 + other * other + tau * tau * e * e - (2 * k.gamma - 1) / (k.gamma * k.gamma) * other;
  }
  const double y = 1 / (k.gamma + 1), u = 1 - 2 * y;  // Bhabha; ICRU Report 37, eq. 2.7
  return 1 - k.beta2 * e * (2 - y * y - e * (u * (3 + y * y) - e * u * u * (1 + u - e * u)));
}

double light_restricted_loss(const Slab& slab, double path, const Kinematics& k, double cut) {
  const double bracket = light_bracket(slab, k, std::min(cut, k.w_max()));
  return std::max(slab.xi * path * k.charge2_per_beta2 * bracket, 0.0);
}

LossMoments light_core_loss(const Slab& slab, double path, const Kinematics& k, const TrackMatter& track) {
  const double xi = slab.xi * path * k.charge2_per_beta2, track_xi = track.xi * k.charge2_per_beta2;
  const double resolved = track.loss.share * k.p / k.per_beta;
  const double wanted = track.loss.mean * track_xi + resolved,
               wanted_variance = track.loss.variance * track_xi + resolved;
  const double cut = std::min(wanted, k.w_max()), hardest = std::min(wanted_variance, k.w_max());
  const double bracket = std::max(light_bracket(slab, k, cut), 0.0);
  // Photons are cut like collisions, but can take all energy.
  const double x0 = track.loss.radiation * slab.x0 * path;
  const double share = std::min(wanted / k.energy, 1.0), mean = radiated_mean(share);
  const double variance = radiated_variance(std::min(wanted_variance / k.energy, 1.0));
  // Per ln(p) the bracket grows by 2, and by the growth of the cut; 1/beta^2 is nearly constant.
  const double grow = 2 + (wanted < k.w_max() ? resolved / cut : 0);
  const double growth = wanted < k.energy ? radiated_growth(share) : 0;
  const double slope = xi * (grow + log_term(slab, k.log_bg).slope) / k.p +
                       x0 * ((mean - share * growth) * k.p / k.energy + growth * resolved / k.p);
  return {xi * bracket + x0 * k.energy * mean, xi * hardest + x0 * k.energy * k.energy * variance, slope};
}

}  // namespace cgemit

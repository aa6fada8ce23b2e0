#include "matter/loss.hpp"

#include <algorithm>

#include "matter/draws.hpp"
#include "matter/radiation.hpp"

namespace cgemit {

namespace {

// -2 ln(I) - delta - 2 C/Z of a slab, and its slope in ln(beta gamma).
Read<double> log_term(const Slab& slab, double log_bg) { return read<&SlabPoint::log_term>(slab, log_bg); }

// Bracket that xi/beta^2 multiplies, for heavy particles and a limit up to w_max.
double heavy_bracket(const Slab& slab, const Kinematics& k, double limit, double w_max) {
  const double bg = k.p * k.per_mass;
  double bracket = std::log(2 * electron_mass * bg * bg * limit) - k.beta2 * (1 + limit / w_max) +
                   log_term(slab, k.log_bg).value;
  if (k.projectile == Projectile::spin_half) bracket += 0.25 * limit * limit / (k.energy * k.energy);
  return bracket;
}

// The same for electrons and positrons: F-(tau, D) and F+(tau, D) of Berger and Seltzer, energies in m_e.
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

// Collisions drawn one by one, expected per slab: more where more is lost, so that a track has some tens in
// all.
double hard_collisions(double xi) { return std::clamp(xi / keV, 0.2, 1.0); }

// A number of given mean 0, variance 1, skewness and excess kurtosis; Cornish and Fisher (1938), third order.
double skewed_normal(double z, double skewness, double kurtosis) {
  const double z2 = z * z;
  return z + skewness / 6 * (z2 - 1) + kurtosis / 24 * z * (z2 - 3) -
         skewness * skewness / 36 * z * (2 * z2 - 5);
}

}  // namespace

void prepare_loss(Detector& detector, CoreLoss choice) {
  constexpr double everything = 1e30, most_probable = 0.2, half_maximum = 4.018 / 2.3548;
  LossCuts& cuts = detector.loss;
  switch (choice) {
    case CoreLoss::truncated:
      cuts = {core_mean_cut, core_variance_cut, 0};
      break;
    case CoreLoss::mean:
      cuts = {everything, everything, 0};
      break;
    case CoreLoss::most_probable:
      cuts = {std::exp(most_probable), half_maximum * half_maximum, 0};
      break;
  }
  cuts.log_mean = std::log(cuts.mean);
}

double spectrum_share(const Kinematics& k, double transfer, double w_max) {
  if (!k.is_light()) {
    const double spin =
        k.projectile == Projectile::spin_half ? 0.5 * transfer * transfer / (k.energy * k.energy) : 0.0;
    return 1 - k.beta2 * transfer / w_max + spin;
  }
  const double e = transfer / k.kinetic();
  if (k.projectile == Projectile::electron) {  // Moller; ICRU Report 37, eq. 2.5
    const double other = e / (1 - e), tau = (k.gamma - 1) / k.gamma;
    return 1 + other * other + tau * tau * e * e - (2 * k.gamma - 1) / (k.gamma * k.gamma) * other;
  }
  const double y = 1 / (k.gamma + 1), u = 1 - 2 * y;  // Bhabha; ICRU Report 37, eq. 2.7
  return 1 - k.beta2 * e * (2 - y * y - e * (u * (3 + y * y) - e * u * u * (1 + u - e * u)));
}

double restricted_loss(const Slab& slab, double path, const Kinematics& k, double cut) {
  const double w_max = k.w_max(), limit = std::min(cut, w_max);
  const double bracket = k.is_light() ? light_bracket(slab, k, limit) : heavy_bracket(slab, k, limit, w_max);
  return std::max(slab.xi * path * k.per_beta2 * bracket, 0.0);
}

LossMoments light_core_loss(const Slab& slab, double path, const Kinematics& k, const TrackMatter& track) {
  const double xi = slab.xi * path * k.per_beta2, track_xi = track.xi * k.per_beta2;
  const double cut = std::min(track.loss.mean * track_xi, k.w_max());
  const double hardest = std::min(track.loss.variance * track_xi, k.w_max());
  const double bracket = std::max(light_bracket(slab, k, cut), 0.0), x0 = slab.x0 * path;
  const double radiated = radiated_mean * x0 * k.energy;
  const double slope = xi * (2 + log_term(slab, k.log_bg).slope) / k.p + radiated_mean * x0 * k.p / k.energy;
  return {xi * bracket + radiated, xi * hardest + radiated_variance * x0 * k.energy * k.energy, slope};
}

double sample_loss(const Slab& slab, double path, const Kinematics& k, const Stream& stream,
                   std::uint32_t place) {
  const double xi = slab.xi * path * k.per_beta2;
  if (!(xi > 0)) return 0;
  const double w_max = k.w_max();
  // The number of collisions above the cut is xi (1/cut - 1/w_max) before the spectrum's factor.
  const double per_max = 1 / w_max, expected = hard_collisions(xi), weight = expected + xi * per_max;
  const double cut = xi / weight;
  const double soft_mean = restricted_loss(slab, path, k, cut);
  // Moments n of xi/E^2 (1 - s E) up to the cut, s = beta^2/w_max.
  const double spin = k.is_light() ? 0.0 : k.beta2 * cut * per_max;
  const double sigma = std::sqrt(xi * cut * (1 - spin / 2));
  const double per_sigma = cut / sigma;
  const double cube = weight * per_sigma * per_sigma * per_sigma;
  const double skewness = cube * (1.0 / 2 - spin / 3), kurtosis = cube * per_sigma * (1.0 / 3 - spin / 4);
  Draws draws(stream, Purpose::energy_loss, place);
  double loss = soft_mean + sigma * skewed_normal(normal_quantile(draws.next()), skewness, kurtosis);
  const double peak = spectrum_peak(k), per_cut = weight / xi, range = per_cut - per_max;
  for (int n = poisson(draws.next(), expected * peak); n > 0; --n) {
    const double transfer = 1 / (per_cut - draws.next() * range);
    if (draws.next() * peak < spectrum_share(k, transfer, w_max)) loss += transfer;
  }
  return std::max(loss, 0.0);
}

}  // namespace cgemit

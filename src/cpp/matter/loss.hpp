// Energy loss by collisions with electrons: moments for the fit, samples for the simulation.
#pragma once

#include <cmath>
#include <span>

#include "matter/draws.hpp"
#include "matter/radiation.hpp"
#include "matter/track.hpp"

namespace cgemit {

// The bracket multiplied by xi/beta^2, for electrons and positrons: F-(tau, D) and F+(tau, D) of Berger and
// Seltzer, energies in m_e.
template <class T>
T light_bracket(const Slab& slab, const KinematicsOf<T>& k, const T& limit) {
  const T tau = k.kinetic() / electron_mass, d = smaller(limit / electron_mass, 0.999999 * tau);
  const T factor = 2 * electron_mass * electron_mass * (k.gamma + 1.0);
  const T term = read<&SlabPoint::log_term>(slab, k.log_bg).value;
  if (k.projectile == Projectile::electron) {
    const T left = tau - d, gamma2 = k.gamma * k.gamma;
    return term - 1.0 - k.beta2 + log(factor * left * d) + tau / left +
           (0.5 * d * d + (2.0 * tau + 1.0) * log(left / tau)) / gamma2;
  }
  const T y = 1.0 / (k.gamma + 1.0), d2 = d * d, d3 = d2 * d;
  return term + log(factor * tau * d) -
         k.beta2 / tau *
             (tau + 2.0 * d - 1.5 * d2 * y - (d - d3 / 3.0) * y * y -
              (0.5 * d2 - tau * d3 / 3.0 + 0.25 * d2 * d2) * y * y * y);
}

// Mean energy loss by collisions with a transfer below `cut` (all of them for cut >= w_max).
// Heavy particles: PDG 2024 eqs. 34.5 and 34.11, with the term of spin 1/2 (Rossi, High Energy Particles,
// 1952, section 2.3); shell correction of Barkas and Berger, so beta gamma > 0.13.
// Electrons and positrons: Berger and Seltzer, NASA SP-3012 (1964), as in ICRU Report 37, eqs. 2.10-2.13.
double light_restricted_loss(const Slab& slab, double path, const Kinematics& k, double cut);
template <class T>
T restricted_loss(const Slab& slab, const T& path, const KinematicsOf<T>& k, const T& cut) {
  if constexpr (lanes_of<T> == 1) {
    if (k.is_light()) return light_restricted_loss(slab, path, k, cut);
  }
  const T w_max = k.w_max(), limit = smaller(cut, w_max), bg = k.p * k.per_mass;
  const T bracket = log(2 * electron_mass * bg * bg * limit) - k.beta2 * (1.0 + limit / w_max) +
                    read<&SlabPoint::log_term>(slab, k.log_bg).value +
                    k.has_spin * (0.25 * limit * limit / (k.energy * k.energy));
  return larger(slab.xi * path * k.charge2_per_beta2 * bracket, 0.0);
}

// A random number with mean 0, variance 1, and given skewness and excess kurtosis; Cornish and Fisher (1938),
// third order.
template <class T>
T skewed_normal(const T& z, const T& skewness, const T& kurtosis) {
  const T z2 = z * z;
  return z + skewness / 6.0 * (z2 - 1.0) + kurtosis / 24.0 * z * (z2 - 3.0) -
         skewness * skewness / 36.0 * z * (2.0 * z2 - 5.0);
}

// The energy loss that the fit subtracts, and its variance.
template <class T>
struct LossMomentsOf {
  T loss;      // GeV
  T variance;  // GeV^2
  T slope;     // d(loss)/d(p), GeV per GeV/c
};
using LossMoments = LossMomentsOf<double>;

// Landau's distribution has no variance, and rare collisions dominate its mean. The fit takes mean and
// variance of all collisions with a transfer below a cut. Kappa at the origin changes by the sum of all
// losses, each with a weight, `Slab::unseen`. A weighted loss is cut at the same value along the whole track,
// so that the moments of slabs add up, and its spectrum is that of one slab with the weighted sum of xi. Slow
// particles (cut above w_max) get Bethe's mean and Vavilov's variance. For electrons and positrons, mean and
// variance of the photons below the cut are added.
//   truncated      the core of what a momentum measurement sees: unseen losses below some of its standard
//                  deviations, straggling included (docs/methods/matter.md)
//   mean           all collisions
//   most_probable  Landau's most probable loss, and the Gaussian as wide as his distribution at half maximum,
//                  4.018 xi; PDG 2024, eq. 34.12
enum class CoreLoss { truncated, mean, most_probable };
// Standard deviations of the core: of heavy particles, whose losses fall as 1/W^2, and of electrons, whose
// photons fall as 1/W.
inline constexpr double core_sigmas = 2.4, light_core_sigmas = 2.6;
inline constexpr double usual_momentum_error = 0.003;

// Sets the loss cuts of a detector, for one error of all momenta. Without `radiation`, electrons and
// positrons lose energy in collisions only.
void prepare_loss(Detector& detector, CoreLoss choice, bool radiation, double momentum_error);

// Whether the fit of electrons takes losses below a cut for the core, and the others for tails.
inline bool truncates_radiation(const Detector& detector) {
  return detector.loss.radiation > 0 && detector.loss.light.sigmas2 > 0;
}

// Relative error without straggling of a particle with this momentum, GeV/c, and tan(lambda) at the origin.
double momentum_error(const MomentumErrors& errors, double p, double charge, double beta, double tanl);

void set_unseen(Slab& slab, double share);

// Fills in `Slab::unseen`. `variances`: of kappa, by the stragglings of all slabs, of a particle from the
// origin, with the shares that the detector had.
void share_loss(Detector& detector, std::span<const double> variances, const Kinematics& start, double tanl);

// The cut of heavy particles, and the numbers that it is made of, GeV.
template <class T>
struct CoreCut {
  T below, resolved2, root;  // W = (below + root)/2, root^2 = below^2 + resolved2
  T wanted;                  // W, of unseen losses
  T own, w_max;              // transfer in the slab that is unseen by so much; the largest transfer
  T share;                   // beta^2/w_max
  T per_recoil;              // 1/(1 + 2 gamma m_e/m + (m_e/m)^2)
  T per_wanted;
  T value;

  CoreCut(const KinematicsOf<T>& k, const TrackMatterOf<T>& track, double per_unseen)
      : below(track.loss.heavy.xi * (track.xi * k.charge2_per_beta2)) {
    const T error = track.error * (k.p * k.beta2 * k.per_beta);
    resolved2 = (4 * track.loss.heavy.sigmas2) * (error * error);
    root = sqrt(below * below + resolved2);
    wanted = 0.5 * (below + root);
    own = wanted * per_unseen;
    const T ratio = electron_mass * k.per_mass, recoil = 1.0 + 2.0 * k.gamma * ratio + ratio * ratio,
            bg = k.p * k.per_mass;
    const T per_both = 1.0 / (recoil * wanted);
    per_recoil = wanted * per_both;
    per_wanted = recoil * per_both;
    w_max = 2 * electron_mass * bg * bg * per_recoil;
    share = (1.0 - k.beta2) * recoil * (1 / (2 * electron_mass));
    value = smaller(own, w_max);
  }
};

// Variance of the core without photons over that with them: photons of t radiation lengths have the variance
// t 2/3 W^2 below a cut W.
template <class T>
T light_rest(const TrackMatterOf<T>& track) {
  constexpr double least = 0.2;
  return larger(1.0 - (2.0 / 3 * track.loss.light.sigmas2 * track.loss.radiation) * track.x0, least);
}
// The cut of the unseen losses of an electron, GeV.
template <class T>
T light_cut(const KinematicsOf<T>& k, const TrackMatterOf<T>& track) {
  const T below = track.loss.light.xi * (track.xi * k.charge2_per_beta2), rest = light_rest(track);
  const T error = track.error * (k.p * k.beta2 * k.per_beta);
  return (below + sqrt(below * below + 4 * track.loss.light.sigmas2 * rest * error * error)) / (2.0 * rest);
}

// Matter and cut of a track, from its momentum at the origin.
template <class T>
TrackMatterOf<T> track_matter(const Detector& detector, const T& tanl, const KinematicsOf<T>& start) {
  TrackMatterOf<T> track = total_matter(detector, tanl);
  if (detector.errors.tanl.empty()) {
    track.error = T(detector.errors.constant);
  } else {
    const T charge = sqrt(start.charge2), beta = start.beta();
    track.error = gathered<T>([&](int i) {
      return momentum_error(detector.errors, lane(start.p, i), lane(charge, i), lane(beta, i), lane(tanl, i));
    });
  }
  if (start.is_light()) return track;
  track.cut = CoreCut<T>(start, track, 1.0).value;
  track.per_cut = 1.0 / track.cut;
  track.log_cut = log(track.cut);
  return track;
}

template <class T>
LossMomentsOf<T> heavy_core_loss(const Slab& slab, T path, const KinematicsOf<T>& k,
                                 const TrackMatterOf<T>& track) {
  const CoreCut<T> cut(k, track, slab.per_unseen);
  const T xi = slab.xi * path * k.charge2_per_beta2;
  const Read<T> term = read<&SlabPoint::log_term>(slab, k.log_bg);
  static const double log_constant = std::log(2 * electron_mass);
  const mask_of<T> is_cut = cut.own < cut.w_max;
  const T reference = select(is_cut, cut.wanted, cut.w_max);
  const T spin = cut.share * cut.value, log_cut = track.log_cut +
                                                  log_ratio(reference, track.cut, track.per_cut) +
                                                  select(is_cut, T(slab.log_per_unseen), T(0.0));
  const T bracket = log_constant + log_cut + 2.0 * k.log_bg - k.beta2 - spin + term.value;
  // Derivatives by ln(p), with 1/gamma^2 = 1 - beta^2: 1/beta^2 falls by 2/gamma^2, (beta gamma)^2 grows by
  // 2, beta^2 by 2 beta^2/gamma^2, p beta by 1 + 1/gamma^2; the cut follows 1/beta^2 and p beta, or w_max.
  const T per_gamma2 = 1.0 - k.beta2;
  const T grow_w_max = 2.0 - 2.0 * electron_mass * k.per_mass * k.gamma * k.beta2 * cut.per_recoil;
  const T both = cut.below + cut.below * cut.below / cut.root;
  const T grow_wanted =
      (0.5 * (1.0 + per_gamma2) * cut.resolved2 / cut.root - per_gamma2 * both) * cut.per_wanted;
  const T grow_cut = select(is_cut, grow_wanted, grow_w_max);
  const T grow_bracket =
      2.0 + grow_cut - 2.0 * k.beta2 * per_gamma2 - spin * (2.0 * per_gamma2 + grow_cut - grow_w_max);
  const T per_log_p = -2.0 * per_gamma2 * bracket + grow_bracket + term.slope;
  const T amount = select(bracket > 0.0, xi, T(0.0));
  const T hardest = smaller(track.loss.variance * cut.own, cut.w_max);
  return {amount * bracket, amount * hardest * (1.0 - 0.5 * cut.share * hardest),
          amount * per_log_p * k.per_p};
}

template <class T>
LossMomentsOf<T> light_core_loss(const Slab& slab, const T& path, const KinematicsOf<T>& k,
                                 const TrackMatterOf<T>& track) {
  const T xi = slab.xi * path * k.charge2_per_beta2, w_max = k.w_max();
  const T unseen = light_cut(k, track), wanted = unseen * slab.per_unseen,
          wanted_variance = track.loss.variance * wanted;
  const T cut = smaller(wanted, w_max), hardest = smaller(wanted_variance, w_max);
  const T bracket = larger(light_bracket(slab, k, cut), 0.0);
  // Photons are cut like collisions, but can take all energy.
  const T x0 = track.loss.radiation * slab.x0 * path, per_energy = 1.0 / k.energy;
  const T y = smaller(wanted * per_energy, 1.0), mean = radiated_mean(y);
  const T variance = radiated_variance(smaller(wanted_variance * per_energy, 1.0));
  // Per ln(p) the bracket grows by 2, and by the growth of the cut, from its equation above; 1/beta^2 is
  // nearly constant.
  const T error = track.error * k.p / k.per_beta, resolved = track.loss.light.sigmas2 * error * error;
  const T rate =
      select(unseen > 0.0, 2.0 * resolved / (resolved + light_rest(track) * unseen * unseen), T(0.0));
  const T grow = 2.0 + select(wanted < w_max, rate, T(0.0));
  const T growth = select(wanted < k.energy, radiated_growth(y), T(0.0));
  const T slope =
      (xi * (grow + read<&SlabPoint::log_term>(slab, k.log_bg).slope) + x0 * growth * wanted * rate) *
          k.per_p +
      x0 * (mean - y * growth) * k.p * per_energy;
  return {xi * bracket + x0 * k.energy * mean, xi * hardest + x0 * k.energy * k.energy * variance, slope};
}

template <class T>
LossMomentsOf<T> core_loss(const Slab& slab, T path, const KinematicsOf<T>& k,
                           const TrackMatterOf<T>& track) {
  return k.is_light() ? light_core_loss(slab, path, k, track) : heavy_core_loss(slab, path, k, track);
}

// Rate of collisions with this transfer, relative to xi/(beta^2 E^2).
double light_spectrum_share(const Kinematics& k, double transfer);
template <class T>
T spectrum_share(const KinematicsOf<T>& k, const T& transfer, const T& w_max) {
  if constexpr (lanes_of<T> == 1) {
    if (k.is_light()) return light_spectrum_share(k, transfer);
  }
  return 1.0 - k.beta2 * transfer / w_max + k.has_spin * (0.5 * transfer * transfer / (k.energy * k.energy));
}
// The largest value of `light_spectrum_share`.
inline double spectrum_peak(Projectile projectile) { return projectile == Projectile::electron ? 2.25 : 1.0; }

// Energy lost in collisions in a slab, GeV. Collisions above a cut are drawn one by one, with the spectrum of
// the particle's spin (Rossi; Moller; Bhabha) up to w_max; the softer ones are drawn together from mean,
// variance, skewness and kurtosis. The mean equals that of `restricted_loss` exactly, and two halves of a
// slab sum to the whole. Lanes are for heavy particles.
template <class T>
T sample_loss(const Slab& slab, const T& path, const KinematicsOf<T>& k, const StreamOf<T>& stream,
              std::uint32_t place) {
  if (!(slab.xi > 0)) return T(0.0);
  const T xi = slab.xi * path * k.charge2_per_beta2, w_max = k.w_max();
  // The number of collisions above the cut is xi (1/cut - 1/w_max) before the spectrum's factor. It is larger
  // where the loss is larger, so that a track has some tens in all.
  const T expected = smaller(larger(xi / keV, 0.2), 1.0), per_max = 1.0 / w_max;
  const T weight = expected + xi * per_max, cut = xi / weight;
  const T soft_mean = restricted_loss(slab, path, k, cut);
  // Moments n of xi/E^2 (1 - s E) up to the cut, s = beta^2/w_max.
  const T spin = k.is_light() ? T(0.0) : k.beta2 * cut * per_max;
  const T sigma = sqrt(xi * cut * (1.0 - spin / 2.0));
  const T per_sigma = cut / sigma, cube = weight * per_sigma * per_sigma * per_sigma;
  const T skewness = cube * (1.0 / 2 - spin / 3.0), kurtosis = cube * per_sigma * (1.0 / 3 - spin / 4.0);
  DrawsOf<T> draws(stream, Purpose::energy_loss, place);
  T loss = soft_mean + sigma * skewed_normal(normal_quantile(draws.next()), skewness, kurtosis);
  const double peak = spectrum_peak(k.projectile);
  const T per_cut = weight / xi, range = per_cut - per_max;
  const T n(poisson(draws.next(), expected * peak));
  for (int i = 0; any(n > i); ++i) {
    const T transfer = 1.0 / (per_cut - draws.next() * range);
    const mask_of<T> happens = draws.next() * peak < spectrum_share(k, transfer, w_max);
    loss += select(happens & (n > i), transfer, T(0.0));
  }
  return larger(loss, 0.0);
}

}  // namespace cgemit

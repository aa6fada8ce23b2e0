// The effects of one slab on a particle: path, energy loss, scattering angle, and their effect on the helix
// parameters at the slab. The reference trajectory and the states along the track share this code.
#pragma once

#include "matter/loss.hpp"
#include "matter/scattering.hpp"

namespace cgemit {

// Change of kappa by the loss: kappa_after = ratio kappa, and d(kappa_after) = gain d(kappa) + mixed d(tanl).
template <class T>
struct LossJacobian {
  T ratio, gain, mixed;
};

// Standard deviations of the noise. Each line is one random number, which may change several parameters. All
// are defined at the slab, for the helix with its pivot there.
template <class T>
struct LocalNoise {
  T turn_psi;             // scattering in the horizontal plane
  T dip_kappa, dip_tanl;  // scattering across the horizontal plane
  T straggling_kappa;     // fluctuations of the loss
  T shift_across;         // sideways shift inside the slab
  T shift_z, shift_psi;   // shift in dip: also along the flight, where the azimuth differs
};

// The dip angle of a track.
template <class T>
struct Dip {
  T tanl, sec;  // tan(lambda), 1/cos(lambda)
  T slope;      // d(ln(sec))/d(tanl)

  explicit Dip(const T& tan_lambda)
      : tanl(tan_lambda), sec(sqrt(1.0 + tanl * tanl)), slope(tanl / (sec * sec)) {}
};

template <class T>
struct SlabCrossing {
  KinematicsOf<T> before, after;
  LossMomentsOf<T> loss;
  T path;   // path over the slab's thickness
  T theta;  // rad, standard deviation of each angle

  // Jacobian of p' = p(E(p) - loss(p, tanl)): dp'/dp at fixed tanl and dp'/dtanl at fixed p.
  LossJacobian<T> jacobian(const T& kappa, const Dip<T>& dip) const {
    const T ratio = before.p * after.per_p;
    const T by_p = after.per_beta * (before.beta() - loss.slope);
    const T by_tanl = -after.per_beta * loss.loss;
    return {ratio, by_p * ratio * ratio,
            kappa * ratio * dip.slope * (1.0 - by_p * ratio - by_tanl * after.per_p)};
  }

  // `w`: curvature of the flight.
  LocalNoise<T> noise(const Slab& slab, const T& kappa, const Dip<T>& dip, const T& w) const {
    const T shift = theta * slab.spread * path;
    return {theta * dip.sec,
            kappa * dip.tanl * theta,
            dip.sec * dip.sec * theta,
            kappa * sqrt(loss.variance) * before.energy * before.per_p * before.per_p,
            shift,
            shift * dip.sec,
            w * shift * dip.slope * dip.sec};
  }
};

template <class T>
mask_of<T> stops(const KinematicsOf<T>& before, const LossMomentsOf<T>& loss) {
  return before.kinetic() - loss.loss < least_kinetic;
}

// Outward crossing, for particles that do not stop.
template <class T>
SlabCrossing<T> cross_outward(const Slab& slab, const T& path, const KinematicsOf<T>& before,
                              const LossMomentsOf<T>& loss, const TrackMatterOf<T>& track) {
  const KinematicsOf<T> after = before.after_loss(loss.loss);
  return {before, after, loss, path, sqrt(scattering_variance(slab, path, before, after, track))};
}

// Inward crossing: the loss is evaluated at the energy before the slab, which is unknown. The loss varies so
// little with energy that a few iterations converge.
inline SlabCrossing<double> cross_inward(const Slab& slab, double path, const Kinematics& after,
                                         const TrackMatter& track) {
  Kinematics before = after;
  LossMoments loss = core_loss(slab, path, after, track);
  for (int i = 0; i < 20; ++i) {
    const double last = loss.loss;
    before = after.after_loss(-last);
    loss = core_loss(slab, path, before, track);
    if (std::abs(loss.loss - last) < 1e-13 * after.energy) break;
  }
  return {before, after, loss, path, sqrt(scattering_variance(slab, path, before, after, track))};
}

}  // namespace cgemit

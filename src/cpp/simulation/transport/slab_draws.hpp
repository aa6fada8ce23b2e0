// Random energy loss and scattering of particles in a slab, as used by the simulation.
#pragma once

#include "matter/foil.hpp"
#include "matter/loss.hpp"
#include "matter/radiation.hpp"
#include "matter/scattering.hpp"
#include "simulation/transport/simulate.hpp"

namespace cgemit {

// Kinetic energy (GeV) below which a particle of this mass counts as stopped. Particles heavier than the
// proton stop at the speed of a proton that does: where Bethe's formula ends, slower ones would cross any
// matter.
template <class T>
T stopped_below(const T& mass) {
  constexpr double proton = 0.94;  // GeV
  return larger(mass * (1 / proton), 1.0) * least_kinetic;
}

template <class T>
struct LossDraw {
  T loss;     // GeV
  T deposit;  // GeV, the part of the loss that stays in the slab: photons leave
};

// All fluctuations. `place`: the RNG counter's.
template <class T>
LossDraw<T> draw_loss(const Slab& slab, const T& path, const KinematicsOf<T>& now, const StreamOf<T>& stream,
                      std::uint32_t place) {
  const T collisions = sample_loss(slab, path, now, stream, place);
  if constexpr (lanes_of<T> == 1) {
    if (now.is_light()) {
      return {collisions + sample_radiation(now.energy, slab.x0 * path, stream, place), collisions};
    }
  }
  return {collisions, collisions};
}

// The Gaussian noise that the fit assumes, or no noise. The loss may be negative in thin matter; the deposit
// in the slab is the expected loss.
template <class T>
LossDraw<T> draw_core_loss(const LossMomentsOf<T>& core, bool fluctuates, const StreamOf<T>& stream,
                           std::uint32_t place) {
  if (!fluctuates) return {core.loss, core.loss};
  DrawsOf<T> draws(stream, Purpose::energy_loss, place);
  return {core.loss + sqrt(core.variance) * normal_quantile(draws.next()), core.loss};
}

// Gaussian angles and shifts. `sigma`: rad, of a plane angle.
template <class T>
KickOf<T> draw_core_kick(const Slab& slab, const T& path, const T& sigma, const StreamOf<T>& stream,
                         std::uint32_t place) {
  DrawsOf<T> draws(stream, Purpose::scattering, place);
  KickOf<T> kick;
  kick.angle_1 = sigma * normal_quantile(draws.next());
  kick.angle_2 = sigma * normal_quantile(draws.next());
  if (slab.shifts) {
    kick.shift_1 = sigma * slab.spread * path * normal_quantile(draws.next());
    kick.shift_2 = sigma * slab.spread * path * normal_quantile(draws.next());
  }
  return kick;
}

// Fraction of the slab outside the holes of its foil that each of the particles `who` crosses.
template <class T>
T foil_fraction(const Slab& slab, const HelixPointOf<T>& point, const StreamOf<T>& stream,
                const mask_of<T>& who) {
  T fraction(1.0);
  if (slab.holes.pitch == 0) return fraction;
  each_lane(who, [&](int i) {
    set_lane(fraction, i, fraction_beside_holes(slab, lane(point, i), lane(stream, i)));
  });
  return fraction;
}

}  // namespace cgemit

// Helix parameters at one point of a track in a field map.
//
// The track is represented by the helix that touches it where it is closest to the pivot in the transverse
// plane. If the pivot lies on a reference trajectory, a neighbouring track is described where it crosses the
// plane across the transverse flight of the reference, as in `FieldDerivatives`, with kappa for charge/p.
#pragma once

#include <cmath>

#include "kalman/group.hpp"
#include "motion/field_motion.hpp"

namespace cgemit {

// Derivatives at the closest point of a helix to its pivot, by (d, psi, kappa, z0, tanl). `point` is the
// closest point.
template <class T>
FieldDerivatives<T> derivatives_by(const PerigeeOf<T>& helix, const HelixPointOf<T>& point, const Vec3<T>& b,
                                   const T& bend) {
  const T zero(0.0), square = 1.0 + helix.tanl * helix.tanl, per_s = 1.0 / sqrt(square);
  const T by_kappa = per_s * (1 / radius_per_kappa);
  // A change of azimuth turns the helix about the pivot and moves the track by d along its flight; the track
  // is then moved back.
  return {{T(-1.0), zero, zero, zero, zero},
          {zero, 1.0 - point.w * helix.d, zero, zero, zero},
          {zero, zero, by_kappa, zero, -helix.kappa * helix.tanl / square * by_kappa},
          {zero, -helix.tanl * helix.d, zero, T(1.0), zero},
          {zero, -slope_rate(point, b, bend) * helix.d, zero, zero, T(1.0)}};
}

// Derivatives of kappa, for a pivot at a point of the track.
template <class T>
std::array<T, parameters> kappa_derivatives(const HelixPointOf<T>& point, const T& charge_per_p,
                                            const FieldDerivatives<T>& by) {
  const T sec = sqrt(1.0 + point.tanl * point.tanl), by_bend = sec * radius_per_kappa,
          by_tanl = charge_per_p * point.tanl / sec;
  std::array<T, parameters> kappa;
  for (std::size_t i = 0; i < parameters; ++i) kappa[i] = by_bend * by.bend[i] + by_tanl * by.tanl[i];
  return kappa;
}

}  // namespace cgemit

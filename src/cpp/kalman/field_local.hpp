// Helix parameters at one point of a track in a field map: what they say of place, direction and charge/p,
// and the other way round.
//
// A helix stands for the track that touches it where it is closest to the pivot, in the transverse plane.
// With the pivot on a reference track, another one is described where it passes the plane across the
// reference's transverse direction of flight.
#pragma once

#include <cmath>

#include "kalman/group.hpp"
#include "motion/field_motion.hpp"

namespace cgemit {

inline double stretch_of(double tanl) { return std::sqrt(1 + tanl * tanl); }

// Derivatives of place, direction and charge/p where a helix is closest to its pivot, by (d, psi, kappa, z0,
// tanl).
inline FieldDerivatives derivatives_by(const Perigee& helix) {
  const double cosine = std::cos(helix.psi), sine = std::sin(helix.psi), d = helix.d, tanl = helix.tanl;
  const double per_s = 1 / stretch_of(tanl), per_s3 = per_s * per_s * per_s;
  FieldDerivatives by;
  by << sine, d * cosine, 0, 0, 0,                      //
      -cosine, d * sine, 0, 0, 0,                       //
      0, 0, 0, 1, 0,                                    //
      0, -sine * per_s, 0, 0, -tanl * cosine * per_s3,  //
      0, cosine * per_s, 0, 0, -tanl * sine * per_s3,   //
      0, 0, 0, 0, per_s3,                               //
      0, 0, per_s / radius_per_kappa, 0, -helix.kappa * tanl * per_s3 / radius_per_kappa;
  return by;
}

// Of the slope of a track at one point, from those of its direction.
inline Eigen::RowVector<double, 5> tanl_derivatives(const HelixPoint& point, const FieldDerivatives& by) {
  return stretch_of(point.tanl) * (by.row(5) - point.tanl * (point.ux * by.row(3) + point.uy * by.row(4)));
}

// Derivatives of (d, psi, kappa, z0, tanl) with the pivot at a point of the track, from those of place,
// direction and charge/p there.
inline Eigen::Matrix<double, 5, 5> local_derivatives(const FieldMotion& motion, const HelixPoint& point,
                                                     const FieldDerivatives& by) {
  const double ux = point.ux, uy = point.uy, tanl = point.tanl, s = stretch_of(tanl), share = tanl / s;
  const Eigen::RowVector<double, 5> by_tanl = tanl_derivatives(point, by);
  // Change of tanl per transverse arc: B has it from its components across the beam.
  const Eigen::Vector<double, 6> along = s * motion.derivative_along(point);
  const double bending = s * (along[5] - tanl * (ux * along[3] + uy * along[4]));
  Eigen::Matrix<double, 5, 5> here;
  for (Eigen::Index i = 0; i < 5; ++i) {
    const auto column = by.col(i);
    const double forward = ux * column[0] + uy * column[1], tanl_here = by_tanl[i] - bending * forward;
    here.col(i) << uy * column[0] - ux * column[1],  //
        s * (ux * column[4] - uy * column[3]) - point.w * forward,
        s * radius_per_kappa * column[6] + motion.charge_per_p() * share * tanl_here,
        column[2] - tanl * forward, tanl_here;
  }
  return here;
}

}  // namespace cgemit

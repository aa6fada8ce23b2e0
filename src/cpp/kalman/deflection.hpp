// A flight that turns by two small angles across itself, at fixed momentum.
#pragma once

#include "motion/helix.hpp"

namespace cgemit {

// With unit vectors t along the flight and e across it, horizontal and the other, the new direction is
// (t + aside e1 + up e2)/|...|.
template <class T>
struct Deflection {
  T cosine, sine;               // of the change of azimuth
  T tanl;                       // behind
  T kappa_ratio;                // kappa = charge/pT behind over before
  T psi_by_tanl, tanl_by_tanl;  // azimuth and tanl behind by tanl before
  T shrinks;                    // -d ln(pT)/d tanl before

  Deflection(const T& tanl_before, const T& aside, const T& up) {
    const T t = tanl_before, sec = sqrt(1.0 + t * t);
    const T ahead = 1.0 - up * t, side = aside * sec, rise = t + up;
    const T per_square = 1.0 / (ahead * ahead + side * side), per_root = sqrt(per_square);
    cosine = ahead * per_root;
    sine = side * per_root;
    tanl = rise * per_root;
    kappa_ratio = sqrt(1.0 + aside * aside + up * up) * per_root;
    shrinks = (aside * aside * t - ahead * up) * per_square;
    psi_by_tanl = aside * rise * per_square / sec;
    tanl_by_tanl = per_root - tanl * shrinks;
  }

  void turn(HelixPointOf<T>& point) const {
    const T ux = cosine * point.ux - sine * point.uy;
    point.uy = cosine * point.uy + sine * point.ux;
    point.ux = ux;
    point.tanl = tanl;
  }
};

}  // namespace cgemit

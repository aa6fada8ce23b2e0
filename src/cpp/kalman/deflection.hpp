// A change of flight direction by two small angles about the axes across the flight, at fixed momentum.
#pragma once

#include "motion/helix.hpp"

namespace cgemit {

// With t the unit vector along the flight and e1 (horizontal) and e2 those across it, the new direction is (t
// + aside e1 + up e2)/|...|.
template <class T>
struct Deflection {
  T cosine, sine;               // of the change of azimuth
  T tanl;                       // after
  T kappa_ratio;                // kappa = charge/pT after over before
  T psi_by_tanl, tanl_by_tanl;  // derivatives of azimuth and tanl after by tanl before
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

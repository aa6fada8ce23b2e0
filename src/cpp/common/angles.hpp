// Azimuths live in (-pi, pi]; distances along a circumference are counted from 0 upwards.
#pragma once

#include <cmath>

#include "common/units.hpp"

namespace cgemit {

// The same direction, written as an angle in (-pi, pi].
inline double wrap_angle(double phi) {
  if (phi > -pi && phi <= pi) return phi;
  const double wrapped = std::remainder(phi, 2 * pi);
  return wrapped <= -pi ? wrapped + 2 * pi : wrapped;
}

// The same direction, written as an angle in [0, 2 pi).
inline double positive_angle(double phi) {
  const double positive = phi >= 0 && phi < 2 * pi ? phi : phi - 2 * pi * std::floor(phi / (2 * pi));
  return positive < 2 * pi ? positive : 0.0;  // a tiny negative angle rounds up to 2 pi
}

// atan(t)/t, exact also where t vanishes.
inline double atan_over(double t) {
  const double q = t * t;
  if (q < 1e-3) return 1.0 + q * (-1.0 / 3 + q * (1.0 / 5 + q * (-1.0 / 7 + q * (1.0 / 9 - q / 11))));
  if (q < 0.02) {
    const double tail = -1.0 / 11 + q * (1.0 / 13 + q * (-1.0 / 15 + q * (1.0 / 17 - q / 19)));
    return 1.0 + q * (-1.0 / 3 + q * (1.0 / 5 + q * (-1.0 / 7 + q * (1.0 / 9 + q * tail))));
  }
  return std::atan(t) / t;
}

}  // namespace cgemit

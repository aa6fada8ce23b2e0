// Azimuths are in (-pi, pi]; distances along a circumference are counted from 0 upwards.
#pragma once

#include <cmath>

#include "common/units.hpp"

namespace cgemit {

// The same direction as an angle in (-pi, pi].
inline double wrap_angle(double phi) {
  if (phi > -pi && phi <= pi) return phi;
  const double wrapped = std::remainder(phi, 2 * pi);
  return wrapped <= -pi ? wrapped + 2 * pi : wrapped;
}

// The same direction as an angle in [0, 2 pi).
inline double positive_angle(double phi) {
  const double positive = phi >= 0 && phi < 2 * pi ? phi : phi - 2 * pi * std::floor(phi / (2 * pi));
  return positive < 2 * pi ? positive : 0.0;  // a tiny negative angle rounds up to 2 pi
}

}  // namespace cgemit

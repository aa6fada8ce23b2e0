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

// Angle in (-pi, pi] from one direction in the plane to another.
inline double turn_between(double from_x, double from_y, double to_x, double to_y) {
  const double across = from_x * to_y - from_y * to_x, along = from_x * to_x + from_y * to_y;
  if (!(std::abs(across) < 0.05 * along)) return std::atan2(across, along);
  // Power series of atan: the next term is below 2e-17.
  const double t = across / along, q = t * t;
  return t * (1 - q * (1.0 / 3 - q * (1.0 / 5 - q * (1.0 / 7 - q * (1.0 / 9 - q / 11)))));
}

}  // namespace cgemit

// Azimuths live in (-pi, pi].
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

}  // namespace cgemit

// A track as a part sees it that is not where the description puts it.
#pragma once

#include "detector/placement.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// The point, in the part's own axes, where a track that has reached a cylinder of the described part reaches
// the real one. The axes differ by milliradians and the points by a millimetre: curvature is kept as it is.
template <class T>
HelixPointOf<T> seen_by(const Placement& part, const HelixPointOf<T>& at) {
  const T radius = at.radius();
  const std::array<T, 3> p =
      turned<T>(part, at.x - part.shift[0], at.y - part.shift[1], at.z - part.shift[2]);
  const std::array<T, 3> u = turned<T>(part, at.ux, at.uy, at.tanl);
  const T per_length = 1.0 / sqrt(u[0] * u[0] + u[1] * u[1]);
  HelixPointOf<T> seen{p[0], p[1], p[2], per_length * u[0], per_length * u[1], per_length * u[2], at.w};
  // Newton's method for the radius; a track along the surface is left where it is.
  constexpr double longest = 10;  // mm
  for (int k = 0; k < 3; ++k) {
    const T outward = seen.outward();
    const T arc = 0.5 * (radius * radius - seen.x * seen.x - seen.y * seen.y) / outward;
    advance(seen, select(abs(arc) < longest, arc, T(0.0)));
  }
  return seen;
}

}  // namespace cgemit

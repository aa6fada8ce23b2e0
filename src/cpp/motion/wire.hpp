// Closest approach of a helix to a straight wire.
#pragma once

#include <cmath>

#include "detector/wires.hpp"
#include "motion/helix.hpp"

namespace cgemit {

template <class T>
struct ApproachOf {
  T doca;        // mm, along n = (flight x wire)/|...|: positive or negative side of the wire
  T nx, ny, nz;  // n at the closest point
  T arc;         // transverse arc from the start to the closest point
  T z_wire;      // z on the wire

  friend ApproachOf select(const mask_of<T>& m, const ApproachOf& a, const ApproachOf& b) {
    return {select(m, a.doca, b.doca), select(m, a.nx, b.nx),   select(m, a.ny, b.ny),
            select(m, a.nz, b.nz),     select(m, a.arc, b.arc), select(m, a.z_wire, b.z_wire)};
  }
};
using Approach = ApproachOf<double>;

inline constexpr int most_wire_steps = 12;

// One step towards the closest approach, where f(s) = (point - wire) . (tangent across the wire) vanishes, by
// the reverted Taylor series of f with three derivatives; from far away the first step is straight.
template <class T>
struct WireStep {
  T arc;
  mask_of<T> possible;  // else the track flies along the wire
  mask_of<T> last;      // the remaining error is small

  WireStep(const HelixPointOf<T>& point, const WireOf<T>& wire, bool first_step) {
    constexpr double accuracy = 1e-5;  // mm along the track; the distance changes with the square of it
    const T dx = point.x - wire.x, dy = point.y - wire.y, dz = point.z;
    const T along = dx * wire.ex + dy * wire.ey + dz * wire.ez;
    const T ue = point.ux * wire.ex + point.uy * wire.ey, te = ue + point.tanl * wire.ez;
    const T ne = point.ux * wire.ey - point.uy * wire.ex;
    const T ahead = dx * point.ux + dy * point.uy;
    const T forward = ahead - along * ue, f = (ahead + dz * point.tanl) - along * te;
    const T bend = point.w * ((dy * point.ux - dx * point.uy) - along * ne);
    const mask_of<T> far = first_step & (abs(bend) > 0.1);
    const T slope = 1.0 + point.tanl * point.tanl - te * te + select(far, T(0.0), bend);
    possible = slope > 0.0;
    const T second = -point.w * (3.0 * te * ne + point.w * forward);
    const T third = -point.w * point.w * (1.0 + 3.0 * ne * ne - 4.0 * te * ue + bend);
    // The terms are grouped so that few of them wait for the division.
    const T per_slope = 1.0 / slope, first = -f * per_slope;
    const T curve = (0.5 * second * per_slope) * first,
            twist = (third * (1.0 / 6) * per_slope) * (first * first);
    const mask_of<T> near = (abs(curve) < 0.1) & !far;
    arc = select(near, first * ((1.0 - curve) + (2.0 * curve * curve - twist)), first);
    // The remaining error is of third order in these.
    const T order = abs(curve) + abs(point.w * arc);
    last = near & (abs(arc) * order * order * order < accuracy);
  }
};

// Distance of a point at its closest approach; `arc` is left at 0.
template <class T>
ApproachOf<T> distance_to_wire(const HelixPointOf<T>& point, const WireOf<T>& wire) {
  const T cx = point.uy * wire.ez - point.tanl * wire.ey, cy = point.tanl * wire.ex - point.ux * wire.ez,
          cz = point.ux * wire.ey - point.uy * wire.ex;
  const T scale = 1.0 / sqrt(cx * cx + cy * cy + cz * cz);
  const T nx = cx * scale, ny = cy * scale, nz = cz * scale;
  const T dx = point.x - wire.x, dy = point.y - wire.y;
  return {dx * nx + dy * ny + point.z * nz,
          nx,
          ny,
          nz,
          T(0.0),
          (dx * wire.ex + dy * wire.ey + point.z * wire.ez) * wire.ez};
}

// Transverse arc of a helix to its closest approach. Returns the lanes of `who` for which it was found.
template <class T>
[[nodiscard]] mask_of<T> arc_to_wire(HelixPointOf<T> point, const WireOf<T>& wire, T& arc, mask_of<T> who) {
  mask_of<T> moving = who, lost(false);
  arc = 0.0;
  for (int iteration = 0; iteration < most_wire_steps; ++iteration) {
    const WireStep<T> next(point, wire, iteration == 0);
    lost = lost | (moving & !next.possible);
    moving = moving & next.possible;
    const T step = select(moving, next.arc, T(0.0));
    arc += step;
    moving = moving & !next.last;
    if (!any(moving)) break;
    advance(point, step);
  }
  return who & !(lost | moving);
}

// Moves `point` to its closest approach. Returns false if this does not converge; the point is then
// undefined. Lanes other than `who` stay where they are.
template <class T>
[[nodiscard]] mask_of<T> approach_wire(HelixPointOf<T>& point, const WireOf<T>& wire, ApproachOf<T>& result,
                                       mask_of<T> who = mask_of<T>(true)) {
  T arc(0.0);
  mask_of<T> moving = who, lost(false);
  for (int iteration = 0; iteration < most_wire_steps && any(moving); ++iteration) {
    const WireStep<T> next(point, wire, iteration == 0);
    lost = lost | (moving & !next.possible);
    moving = moving & next.possible;
    const T step = select(moving, next.arc, T(0.0));
    advance(point, step);
    arc += step;
    moving = moving & !next.last;
  }
  result = distance_to_wire(point, wire);
  result.arc = arc;
  return who & !(lost | moving);
}

}  // namespace cgemit

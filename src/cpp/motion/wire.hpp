// Closest approach of a helix to a straight wire.
#pragma once

#include <cmath>

#include "detector/wires.hpp"
#include "motion/helix.hpp"

namespace cgemit {

struct Approach {
  double doca;        // mm, along n = (flight x wire)/|...|: positive or negative side of the wire
  double nx, ny, nz;  // n at the closest point
  double arc;         // transverse arc from the start to the closest point
  double z_wire;      // z on the wire
};

// Moves `point` to its closest approach: where f(s) = (point - wire) . (tangent across the wire) vanishes, by
// Newton's method with the second derivative; from far away the first step is straight. Returns false if that
// does not settle.
[[nodiscard]] inline bool approach_wire(HelixPoint& point, const Wire& wire, Approach& result) {
  double arc = 0;
  for (int iteration = 0; iteration < 12; ++iteration) {
    const double dx = point.x - wire.x, dy = point.y - wire.y, dz = point.z;
    const double along = dx * wire.ex + dy * wire.ey + dz * wire.ez;
    const double px = dx - along * wire.ex, py = dy - along * wire.ey, pz = dz - along * wire.ez;
    const double te = point.ux * wire.ex + point.uy * wire.ey + point.tanl * wire.ez;
    const double forward = px * point.ux + py * point.uy, f = forward + pz * point.tanl;
    const double bend = point.w * (py * point.ux - px * point.uy);
    const bool far = iteration == 0 && std::abs(bend) > 0.1;
    const double slope = 1.0 + point.tanl * point.tanl - te * te + (far ? 0.0 : bend);
    if (!(slope > 0)) return false;
    const double ne = point.ux * wire.ey - point.uy * wire.ex;
    const double second = -point.w * (3 * te * ne + point.w * forward);
    const double per_slope = 1 / slope, first = -f * per_slope, curve = 0.5 * second * first * per_slope;
    const bool near = !far && std::abs(curve) < 0.1;
    const double step = near ? first * (1 - curve) : first;
    advance(point, step);
    arc += step;
    // What is left along the track is of third order; the distance changes with the square of that.
    const double left =
        std::abs(step) * (2 * curve * curve + 4 * point.w * point.w * step * step * per_slope);
    if (near && left < 1e-6) {
      const double cx = point.uy * wire.ez - point.tanl * wire.ey,
                   cy = point.tanl * wire.ex - point.ux * wire.ez,
                   cz = point.ux * wire.ey - point.uy * wire.ex;
      const double scale = 1.0 / std::sqrt(cx * cx + cy * cy + cz * cz);
      result.nx = cx * scale;
      result.ny = cy * scale;
      result.nz = cz * scale;
      const double ddx = point.x - wire.x, ddy = point.y - wire.y;
      result.doca = ddx * result.nx + ddy * result.ny + point.z * result.nz;
      result.arc = arc;
      result.z_wire = (ddx * wire.ex + ddy * wire.ey + point.z * wire.ez) * wire.ez;
      return true;
    }
  }
  return false;
}

}  // namespace cgemit

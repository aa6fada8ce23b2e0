// Motion in a uniform field along z: exact helix steps, without angles, accurate from tight curls to straight
// lines.
//
// A point carries the transverse unit direction u and the curvature w = d(psi)/ds, psi the flight azimuth and
// s the transverse arc. With r the distance from the beam line and a the angle between u and the radius,
//   S = r sin a = x u_y - y u_x,   P = r cos a = x u_x + y u_y,   dS/ds = w P,   d(r^2)/ds = 2 P,
// so that S grows by w (r1^2 - r0^2) / 2 from one cylinder to the next whatever the step: no cancellation,
// nothing special at w = 0.
#pragma once

#include <cmath>

#include "common/angles.hpp"
#include "common/units.hpp"

namespace cgemit {

struct HelixPoint {
  double x, y, z;  // mm
  double ux, uy;   // transverse direction of flight, unit vector
  double tanl;     // dz/ds
  double w;        // 1/mm, turning per transverse arc

  double radius() const { return std::sqrt(x * x + y * y); }
  double outward() const { return x * ux + y * uy; }   // P
  double sideways() const { return x * uy - y * ux; }  // S
};

// w of a track with kappa = charge/pT; positive charge in positive field turns clockwise.
inline double curvature(double bz, double kappa) { return -bz * kappa / radius_per_kappa; }

// Moves along the chord of a turn by 2 atan(t): h = tan(half the turn)/w is half of what the step would be if
// straight.
inline void turn(HelixPoint& point, double h, double t) {
  const double q = t * t;
  const double scale = q < 1e-4 ? 1.0 - q * (1.0 - q * (1.0 - q * (1.0 - q))) : 1.0 / (1.0 + q);
  const double chord = 2.0 * h * scale;
  point.x += chord * (point.ux - t * point.uy);
  point.y += chord * (point.uy + t * point.ux);
  const double cosine = (1.0 - q) * scale, sine = 2.0 * t * scale;
  const double ux = cosine * point.ux - sine * point.uy;
  point.uy = cosine * point.uy + sine * point.ux;
  point.ux = ux;
}

// Moves to the cylinder of radius r. `outward`: to where the helix leaves it. That lies ahead from inside the
// cylinder; from outside, on the way out, it lies behind (a negative arc). Else to where the helix enters it,
// for a point outside on its way in. Returns false, leaving the point alone, when the helix does not reach
// it. `arc` receives the transverse path.
[[nodiscard]] inline bool step_to_cylinder(HelixPoint& point, double r, double& arc, bool outward = true) {
  const double r0_squared = point.x * point.x + point.y * point.y;
  const double difference = r * r - r0_squared;
  const double s1 = point.sideways() + 0.5 * point.w * difference;
  const double p1_squared = r * r - s1 * s1;
  if (!(p1_squared >= 0)) return false;
  const double p1 = outward ? std::sqrt(p1_squared) : -std::sqrt(p1_squared);
  const double p0 = point.outward();
  // Two forms of one number; each is a difference of equals where the other is not. Heading in and leaving on
  // the other side needs the second, above all when the point lies on the cylinder.
  const bool through = outward && p0 < 0;
  double h = 0;
  if (through) {
    h = 0.5 * (p1 - p0) / (1.0 - point.w * (point.sideways() + 0.25 * point.w * difference));
  } else if (p0 + p1 != 0) {
    h = 0.5 * difference / (p0 + p1);
  } else if (difference != 0) {
    return false;
  }
  const double t = point.w * h;
  // On the way through, h < 0 is a turn by more than pi; otherwise it is a step back to a smaller radius.
  const bool far_side = through && h < 0;
  arc = far_side ? (2.0 * std::atan(t) + std::copysign(2.0 * pi, point.w)) / point.w : 2.0 * h * atan_over(t);
  turn(point, h, t);
  point.z += arc * point.tanl;
  return true;
}

// tan(f)/f, exact to rounding; by its series where that is short.
inline double tangent_over(double f) {
  const double q = f * f;
  if (q > 1e-3) return std::tan(f) / f;
  return 1 + q * (1.0 / 3 + q * (2.0 / 15 + q * (17.0 / 315 + q * (62.0 / 2835))));
}

// Moves by a transverse arc, forward or back.
inline void advance(HelixPoint& point, double arc) {
  const double h = 0.5 * arc * tangent_over(0.5 * point.w * arc);
  turn(point, h, point.w * h);
  point.z += arc * point.tanl;
}

// Transverse arc ahead to the point farthest from the beam line, where P falls through 0; infinite if
// straight.
inline double arc_to_apex(const HelixPoint& point) {
  if (point.w == 0) return HUGE_VAL;
  const double bend = std::abs(point.w);
  // P after a turn theta is P cos(theta) + (1/|w| -+ S) sin(theta).
  const double side = 1.0 / bend - std::copysign(point.sideways(), point.w * point.sideways());
  double theta = std::atan2(side, point.outward()) + 0.5 * pi;
  if (theta < 0) theta += 2.0 * pi;
  return theta / bend;
}

}  // namespace cgemit

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
#include <type_traits>

#include "common/angles.hpp"
#include "common/lanes/math.hpp"
#include "common/units.hpp"

namespace cgemit {

template <class T>
struct HelixPointOf {
  T x, y, z;  // mm
  T ux, uy;   // transverse direction of flight, unit vector
  T tanl;     // dz/ds
  T w;        // 1/mm, turning per transverse arc

  T radius() const { return sqrt(x * x + y * y); }
  T outward() const { return x * ux + y * uy; }  // P
  // Whether the point is not before the closest approach, where P is 0 but for rounding, mm.
  mask_of<T> is_outward() const { return outward() > -1e-9; }
  T sideways() const { return x * uy - y * ux; }  // S
};
using HelixPoint = HelixPointOf<double>;

template <class T>
HelixPointOf<T> select(const mask_of<T>& m, const HelixPointOf<T>& a, const HelixPointOf<T>& b) {
  return {select(m, a.x, b.x),   select(m, a.y, b.y),       select(m, a.z, b.z), select(m, a.ux, b.ux),
          select(m, a.uy, b.uy), select(m, a.tanl, b.tanl), select(m, a.w, b.w)};
}

// A helix by its closest approach to a pivot: psi is the flight azimuth there, phi0 + pi/2.
template <class T>
struct PerigeeOf {
  T d, psi, kappa, z0, tanl;
};
using Perigee = PerigeeOf<double>;

template <class T>
PerigeeOf<T> select(const mask_of<T>& m, const PerigeeOf<T>& a, const PerigeeOf<T>& b) {
  return {select(m, a.d, b.d), select(m, a.psi, b.psi), select(m, a.kappa, b.kappa), select(m, a.z0, b.z0),
          select(m, a.tanl, b.tanl)};
}

// The closest point to the pivot (x, y, z). `per_kappa`: curvature for kappa = 1, or 0 if w is set later.
template <class T>
HelixPointOf<T> closest_point(const PerigeeOf<T>& helix, double per_kappa, const T& x = T(0.0),
                              const T& y = T(0.0), const T& z = T(0.0)) {
  const SineCosine<T> psi = sine_cosine(helix.psi);
  return {x + helix.d * psi.sine, y - helix.d * psi.cosine, z + helix.z0, psi.cosine, psi.sine, helix.tanl,
          per_kappa * helix.kappa};
}

// The closest approach of a helix to a pivot, seen from one of its points: less than half a turn away.
struct PivotApproach {
  double d, turn, arc;  // mm, rad of azimuth, mm along the transverse arc
  bool exists;          // else the pivot is the centre of the circle
};
inline PivotApproach approach_pivot(const HelixPoint& point, double x, double y) {
  const double dx = point.x - x, dy = point.y - y;
  const double sideways = dx * point.uy - dy * point.ux, outward = dx * point.ux + dy * point.uy;
  const double across = 1 - point.w * sideways, along = point.w * outward;
  const double reach = std::sqrt(across * across + along * along);  // distance to the centre over |R|
  const double turn = -std::atan2(along, across);
  const double arc = across > 0 ? -outward / across * atan_over(along / across) : turn / point.w;
  return {(2 * sideways - point.w * (dx * dx + dy * dy)) / (1 + reach), turn, arc, reach > 1e-12};
}

// w of a track with kappa = charge/pT; positive charge in positive field turns clockwise.
template <class T>
T curvature(double bz, T kappa) {
  return kappa * (-bz / radius_per_kappa);
}

// Moves along the chord of a turn by 2 atan(t): h = tan(half the turn)/w is half of the length of the step if
// straight.
template <class T>
void turn(HelixPointOf<T>& point, T h, T t) {
  const T q = t * t;
  const T scale = choose(
      q < 1e-4,
      [&q] {
        const T brief = 1.0 - q, q2 = q * q;
        return brief + q2 * (brief + q2);
      },
      [&q] { return 1.0 / (1.0 + q); });
  const T chord = 2.0 * h * scale;
  point.x += chord * (point.ux - t * point.uy);
  point.y += chord * (point.uy + t * point.ux);
  const T cosine = (1.0 - q) * scale, sine = 2.0 * t * scale;
  const T ux = cosine * point.ux - sine * point.uy;
  point.uy = cosine * point.uy + sine * point.ux;
  point.ux = ux;
}

// Moves to the cylinder of radius r. With `outward`, to the point where the helix leaves it: this point is
// ahead if the start is inside the cylinder, and behind (a negative arc) if the start is outside and moving
// outward. Otherwise to the point where the helix enters it, for a start outside that moves inward. Returns
// false and leaves the point unchanged if the helix does not reach the cylinder. `arc` receives the
// transverse path, 0 if there is none. Lanes other than `who` stay where they are.
template <class T>
[[nodiscard]] mask_of<T> step_to_cylinder(HelixPointOf<T>& point, std::type_identity_t<T> r, T& arc,
                                          bool outward = true, mask_of<T> who = mask_of<T>(true)) {
  const T r0_squared = point.x * point.x + point.y * point.y;
  const T difference = r * r - r0_squared;
  const T s1 = point.sideways() + 0.5 * point.w * difference;
  const T p1_squared = r * r - s1 * s1;
  mask_of<T> reached = who & (p1_squared >= 0.0);
  arc = 0.0;
  if (!any(reached)) return reached;
  const T root = sqrt(larger(p1_squared, 0.0)), p1 = outward ? root : -root;
  const T p0 = point.outward();
  // Two forms of one number; each is a difference of equal terms where the other is not. A helix that moves
  // inward and leaves on the other side needs the second, above all if the point lies on the cylinder.
  const mask_of<T> through = outward & (p0 < 0.0);
  const T sum = p0 + p1;
  const auto no_step = sum == 0.0;  // a tangent: only a point that lies on the cylinder has reached it
  T h = choose(
      through,
      [&] { return 0.5 * (p1 - p0) / (1.0 - point.w * (point.sideways() + 0.25 * point.w * difference)); },
      [&] { return select(no_step, T(0.0), 0.5 * difference / select(no_step, T(1.0), sum)); });
  reached = reached & (through | !no_step | (difference == 0.0));
  h = select(reached, h, T(0.0));
  const T t = point.w * h;
  // On a helix that crosses the cylinder's inside, h < 0 is a turn by more than pi; otherwise it is a step
  // back to a smaller radius.
  const mask_of<T> far_side = through & (h < 0.0);
  const T near_arc = 2.0 * h * atan_over(t);
  arc = any(far_side) ? select(far_side, (2.0 * atan(t) + copysign(T(2.0 * pi), point.w)) / point.w, near_arc)
                      : near_arc;
  turn(point, h, t);
  point.z += arc * point.tanl;
  return reached;
}

// The same helix flown in the opposite direction.
template <class T>
HelixPointOf<T> reversed(const HelixPointOf<T>& p) {
  return {p.x, p.y, p.z, -p.ux, -p.uy, -p.tanl, -p.w};
}

// Moves by a transverse arc, forward or backward: along its chord, which points half of the turn ahead.
template <class T>
void advance(HelixPointOf<T>& point, std::type_identity_t<T> arc) {
  const T half_turn = 0.5 * point.w * arc;
  const SineOver<T> half(half_turn);
  const T s = half_turn * half.sine_over, c = half.cosine, chord = arc * half.sine_over;
  point.x += chord * (c * point.ux - s * point.uy);
  point.y += chord * (c * point.uy + s * point.ux);
  point.z += arc * point.tanl;
  const T cosine = 1.0 - 2.0 * s * s, sine = 2.0 * s * c;
  const T ux = cosine * point.ux - sine * point.uy;
  point.uy = cosine * point.uy + sine * point.ux;
  point.ux = ux;
}

// (1 - cos f)/f^2 and (f - sin f)/f^2: the integral of the position over a helix step.
template <class T>
struct StepIntegral {
  T along, across;
};
template <class T>
StepIntegral<T> step_integral(T f) {
  const T q = f * f;
  const auto is_short = q < 0.25;
  StepIntegral<T> i{
      0.5 + q * (-1.0 / 24 +
                 q * (1.0 / 720 + q * (-1.0 / 40320 + q * (1.0 / 3628800 - q * (1.0 / 479001600))))),
      f * (1.0 / 6 + q * (-1.0 / 120 + q * (1.0 / 5040 + q * (-1.0 / 362880 + q * (1.0 / 39916800)))))};
  if (all(is_short)) return i;
  const SineCosine<T> s = sine_cosine(f);
  return {select(is_short, i.along, (1.0 - s.cosine) / q), select(is_short, i.across, (f - s.sine) / q)};
}

// Transverse arc ahead to the point farthest from the beam line, where P falls through 0; infinite for a
// straight track.
template <class T>
T arc_to_apex(const HelixPointOf<T>& point) {
  const T bend = abs(point.w), sideways = point.sideways();
  // P after a turn theta is P cos(theta) + (1/|w| -+ S) sin(theta).
  const T side = 1.0 / bend - copysign(sideways, point.w * sideways);
  const T theta = atan2(side, point.outward()) + 0.5 * pi;
  return select(bend == 0.0, T(HUGE_VAL), select(theta < 0.0, theta + 2.0 * pi, theta) / bend);
}

}  // namespace cgemit

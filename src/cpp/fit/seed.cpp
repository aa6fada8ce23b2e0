#include "fit/seed.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "common/angles.hpp"
#include "detector/wires.hpp"
#include "motion/helix.hpp"

namespace cgemit {

namespace {

struct Circle {
  double x, y, radius;
};

struct Point {
  double x, y;
};

// Algebraic circle fit of Taubin (IEEE PAMI 13 (1991) 1115), solved by Newton's method as in Chernov,
// "Circular and Linear Regression" (2010), sec. 5.9. Nearly unbiased also for short arcs.
std::optional<Circle> fit_circle(std::span<const Point> points) {
  const auto n = static_cast<double>(points.size());
  if (points.size() < 3) return std::nullopt;
  double mx = 0, my = 0;
  for (const Point& p : points) {
    mx += p.x / n;
    my += p.y / n;
  }
  double xx = 0, yy = 0, xy = 0, xz = 0, yz = 0, zz = 0;
  for (const Point& p : points) {
    const double x = p.x - mx, y = p.y - my, z = x * x + y * y;
    xx += x * x / n;
    yy += y * y / n;
    xy += x * y / n;
    xz += x * z / n;
    yz += y * z / n;
    zz += z * z / n;
  }
  const double mean_z = xx + yy, determinant = xx * yy - xy * xy, variance_z = zz - mean_z * mean_z;
  const double a3 = 4 * mean_z, a2 = -3 * mean_z * mean_z - zz;
  const double a1 = variance_z * mean_z + 4 * determinant * mean_z - xz * xz - yz * yz;
  const double a0 = xz * (xz * yy - yz * xy) + yz * (yz * xx - xz * xy) - variance_z * determinant;
  double root = 0;
  for (int i = 0; i < 30; ++i) {
    const double value = a0 + root * (a1 + root * (a2 + root * a3));
    const double slope = a1 + root * (2 * a2 + root * 3 * a3);
    const double step = value / slope;
    if (!std::isfinite(step)) return std::nullopt;
    root -= step;
    if (std::abs(step) <= 1e-12 * std::abs(root)) break;
  }
  const double scale = 2 * (root * root - root * mean_z + determinant);
  if (scale == 0) return std::nullopt;
  const double cx = (xz * (yy - root) - yz * xy) / scale, cy = (yz * (xx - root) - xz * xy) / scale;
  const double radius = std::sqrt(cx * cx + cy * cy + mean_z);
  if (!std::isfinite(radius)) return std::nullopt;
  return Circle{cx + mx, cy + my, radius};
}

// Where the track is, as far as a wire tells: on the wire, or beside it when the side is known.
Point beside(const Wire& wire, double signed_drift, const Point& at, const Circle* circle) {
  if (circle == nullptr || signed_drift == 0) return at;
  // Positive side: along (flight x wire), the right-hand side of the flight for a wire along +z.
  const double dx = at.x - circle->x, dy = at.y - circle->y, distance = std::hypot(dx, dy);
  const double outward = signed_drift / (distance * std::max(wire.ez, 0.5));
  return {at.x + outward * dx, at.y + outward * dy};
}

// Turning direction of the flight from the innermost to the outermost point: +1 anticlockwise.
double turning(const Circle& circle, const Point& first, const Point& last) {
  const double ax = first.x - circle.x, ay = first.y - circle.y, bx = last.x - circle.x,
               by = last.y - circle.y;
  return ax * by - ay * bx > 0 ? 1.0 : -1.0;
}

struct Line {
  double z0, tanl;
};

// z at the arc of every stereo wire, where the wire meets the circle; straight line, weakly tied to the
// origin.
std::optional<Line> fit_line(const Detector& detector, std::span<const Hit> hits,
                             std::span<const std::int8_t> sides, const Circle& circle, double turn,
                             const Point& closest) {
  constexpr double z_scale = 300;  // mm, spread of z0 that the tie to the origin allows
  double n = 0, s1 = 0, s2 = 0, z1 = 0, sz = 0;
  const double start = std::atan2(closest.y - circle.y, closest.x - circle.x);
  for (std::size_t i = 0; i < hits.size(); ++i) {
    if (hits[i].view != View::wire) continue;
    const WireLayer& layer = detector.wires[static_cast<std::size_t>(hits[i].layer)];
    if (layer.twist == 0) continue;
    const Wire& wire = layer.placed[static_cast<std::size_t>(hits[i].element)];
    const double side = sides[i] * turn;  // the right-hand side lies outside an anticlockwise circle
    const double target = circle.radius - side * hits[i].value;
    // |wire(z) - centre| = target along the wire.
    const double gx = wire.ex / wire.ez, gy = wire.ey / wire.ez;
    const double dx = wire.x - circle.x, dy = wire.y - circle.y;
    const double a = gx * gx + gy * gy, b = dx * gx + dy * gy, c = dx * dx + dy * dy - target * target;
    const double q = b * b - a * c;
    if (q < 0) continue;
    const double root = std::sqrt(q), z_a = (-b + root) / a, z_b = (-b - root) / a;
    const double z = std::abs(z_a) < std::abs(z_b) ? z_a : z_b;
    if (std::abs(z) > 1.2 * layer.half_length) continue;
    double turned = turn * (std::atan2(dy + gy * z, dx + gx * z) - start);
    turned -= 2 * pi * std::floor(turned / (2 * pi));
    const double s = turned * circle.radius;
    n += 1;
    s1 += s;
    s2 += s * s;
    z1 += z;
    sz += s * z;
  }
  if (n < 2) return std::nullopt;
  const double drift_in_z = 100;  // mm, error of z by the unknown drift distance over the stereo angle
  n += drift_in_z * drift_in_z / (z_scale * z_scale);
  const double determinant = n * s2 - s1 * s1;
  return Line{(z1 * s2 - sz * s1) / determinant, (n * sz - s1 * z1) / determinant};
}

}  // namespace

std::optional<Perigee> seed_from_wires(const Detector& detector, std::span<const Hit> hits,
                                       std::span<const std::int8_t> sides) {
  std::vector<Point> points;
  points.reserve(hits.size());
  std::optional<Circle> circle;
  double turn = 1;
  const bool known = std::ranges::any_of(sides, [](std::int8_t side) { return side != 0; });
  for (int pass = 0; pass < (known ? 2 : 1); ++pass) {
    points.clear();
    for (std::size_t i = 0; i < hits.size(); ++i) {
      if (hits[i].view != View::wire) continue;
      const WireLayer& layer = detector.wires[static_cast<std::size_t>(hits[i].layer)];
      if (layer.twist != 0) continue;
      const Wire& wire = layer.placed[static_cast<std::size_t>(hits[i].element)];
      points.push_back(
          beside(wire, sides[i] * hits[i].value * turn, {wire.x, wire.y}, circle ? &*circle : nullptr));
    }
    circle = fit_circle(points);
    if (!circle) return std::nullopt;
    turn = turning(*circle, points.front(), points.back());
  }
  // Perigee: the point of the circle closest to the beam line.
  const double centre = std::hypot(circle->x, circle->y);
  if (centre == 0) return std::nullopt;
  const double to_closest = 1 - circle->radius / centre;
  const Point closest{circle->x * to_closest, circle->y * to_closest};
  const double w = turn / circle->radius;
  // Flight at the perigee: the centre lies to the left of an anticlockwise flight.
  const double ux = turn * circle->y / centre, uy = -turn * circle->x / centre;
  const double psi = std::atan2(uy, ux);
  const auto line = fit_line(detector, hits, sides, *circle, turn, closest);
  if (!line) return std::nullopt;
  const double kappa = w / curvature(detector.bz, 1.0);
  return Perigee{(closest.x * std::sin(psi) - closest.y * std::cos(psi)), psi, kappa, line->z0, line->tanl};
}

}  // namespace cgemit

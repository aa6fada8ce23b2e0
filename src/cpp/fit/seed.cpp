#include "fit/seed.hpp"

#include <Eigen/Cholesky>
#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "common/angles.hpp"
#include "detector/strip_plane.hpp"
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

// Weighted straight line z(s).
class LineFit {
 public:
  void add(double s, double z, double sigma) {
    const double weight = 1 / (sigma * sigma);
    n_ += weight;
    s1_ += weight * s;
    s2_ += weight * s * s;
    z1_ += weight * z;
    sz_ += weight * s * z;
    ++points_;
  }
  // A weak tie to the origin keeps two close points from pointing anywhere.
  std::optional<Line> result() const {
    constexpr double z_spread = 300;  // mm, of z0
    if (points_ < 2) return std::nullopt;
    const double n = n_ + 1 / (z_spread * z_spread);
    const double determinant = n * s2_ - s1_ * s1_;
    return Line{(z1_ * s2_ - sz_ * s1_) / determinant, (n * sz_ - s1_ * z1_) / determinant};
  }

 private:
  double n_ = 0, s1_ = 0, s2_ = 0, z1_ = 0, sz_ = 0;
  int points_ = 0;
};

// Transverse arc from the closest approach to the beam line, along a circle flown through in direction
// `turn`.
class Arc {
 public:
  Arc(const Circle& circle, double turn, const Point& closest)
      : circle_(circle), turn_(turn), start_(std::atan2(closest.y - circle.y, closest.x - circle.x)) {}
  double operator()(double x, double y) const {
    double turned = turn_ * (std::atan2(y - circle_.y, x - circle_.x) - start_);
    turned -= 2 * pi * std::floor(turned / (2 * pi));
    return turned * circle_.radius;
  }

 private:
  Circle circle_;
  double turn_, start_;
};

// z and arc where a stereo wire meets the circle (moved to the wire's side of the track where that is known).
void add_wire(const WireLayer& layer, const Hit& hit, double side, const Circle& circle, const Arc& arc,
              LineFit& line) {
  const Wire& wire = layer.placed[static_cast<std::size_t>(hit.element)];
  const double target = circle.radius - side * hit.value;
  const double gx = wire.ex / wire.ez, gy = wire.ey / wire.ez;
  const double dx = wire.x - circle.x, dy = wire.y - circle.y;
  // |wire(z) - centre| = target along the wire.
  const double a = gx * gx + gy * gy, b = dx * gx + dy * gy, c = dx * dx + dy * dy - target * target;
  const double q = b * b - a * c;
  if (q < 0) return;
  const double root = std::sqrt(q), z_a = (-b + root) / a, z_b = (-b - root) / a;
  const double z = std::abs(z_a) < std::abs(z_b) ? z_a : z_b;
  if (std::abs(z) > 1.2 * layer.half_length) return;
  constexpr double sigma = 100;  // mm, the unknown drift distance over the stereo angle
  line.add(arc(wire.x + gx * z, wire.y + gy * z), z, sigma);
}

// Where an X cluster lies in the middle of the drift gap.
Point cluster_point(const CgemLayer& layer, const Hit& x) {
  const double phi = azimuth(layer, x.element, x.value);
  return {layer.r_mid() * std::cos(phi), layer.r_mid() * std::sin(phi)};
}

std::vector<Point> axial_points(const Detector& detector, std::span<const Hit> hits,
                                std::span<const std::int8_t> sides, SeedFrom from, double turn,
                                const Circle* circle) {
  std::vector<Point> points;
  points.reserve(hits.size());
  for (std::size_t i = 0; i < hits.size(); ++i) {
    const auto index = static_cast<std::size_t>(hits[i].layer);
    if (hits[i].view == View::wire && detector.wires[index].twist == 0) {
      const Wire& wire = detector.wires[index].placed[static_cast<std::size_t>(hits[i].element)];
      points.push_back(beside(wire, sides[i] * hits[i].value * turn, {wire.x, wire.y}, circle));
    } else if (hits[i].view == View::x && from == SeedFrom::wires_and_clusters) {
      points.push_back(cluster_point(detector.cgem[index], hits[i]));
    }
  }
  return points;
}

std::optional<Line> fit_line(const Detector& detector, std::span<const Hit> hits,
                             std::span<const std::int8_t> sides, SeedFrom from, const Circle& circle,
                             double turn, const Arc& arc) {
  LineFit line;
  for (std::size_t i = 0; i < hits.size(); ++i) {
    const auto index = static_cast<std::size_t>(hits[i].layer);
    if (hits[i].view == View::wire) {
      // The right-hand side of the flight lies outside an anticlockwise circle.
      if (detector.wires[index].twist != 0)
        add_wire(detector.wires[index], hits[i], sides[i] * turn, circle, arc, line);
    } else if (from == SeedFrom::wires_and_clusters && hits[i].view == View::v) {
      // X clusters precede V clusters of their sheet.
      const bool pair = i > 0 && hits[i - 1].view == View::x && hits[i - 1].layer == hits[i].layer &&
                        hits[i - 1].element == hits[i].element;
      if (!pair) continue;
      const CgemLayer& layer = detector.cgem[index];
      const Point place = cluster_point(layer, hits[i - 1]);
      line.add(arc(place.x, place.y), crossing_z(layer, hits[i - 1].value, hits[i].value), 1.0);
    }
  }
  return line.result();
}

// Track from the beam line, azimuth psi0 + w r/2 and z = z0 + tanl r, through wires whose azimuth at z is
// phi + slope z: linear in (psi0, w/2, z0, tanl). For chambers with few axial layers.
std::optional<Perigee> seed_from_azimuths(const Detector& detector, std::span<const Hit> hits) {
  Eigen::Matrix4d normal = Eigen::Matrix4d::Zero();
  // Weak ties, in units of the wires' error: curvature 1/300 mm, z0 300 mm, tanl 3.
  constexpr double error = 0.02;  // rad, half a cell
  normal.diagonal() << 0, 1 / std::pow(1.0 / 300, 2), 1 / std::pow(300.0, 2), 1 / 9.0;
  normal *= error * error;
  Eigen::Vector4d right = Eigen::Vector4d::Zero();
  double first = 0;
  int points = 0;
  for (const Hit& hit : hits) {
    if (hit.view != View::wire) continue;
    const WireLayer& layer = detector.wires[static_cast<std::size_t>(hit.layer)];
    const Wire& wire = layer.placed[static_cast<std::size_t>(hit.element)];
    const double phi = std::atan2(wire.y, wire.x), r = std::sqrt(layer.waist);
    if (points == 0) first = phi;
    const double slope = layer.tan_half_twist / layer.half_length;
    const Eigen::Vector4d row(1, r, -slope, -slope * r);
    normal += row * row.transpose();
    right += row * wrap_angle(phi - first);
    ++points;
  }
  if (points < 5) return std::nullopt;
  const Eigen::Vector4d found = normal.ldlt().solve(right);
  if (!found.allFinite()) return std::nullopt;
  const double kappa = 2 * found[1] / curvature(detector.bz, 1.0);
  return Perigee{0, wrap_angle(first + found[0]), kappa, found[2], found[3]};
}

}  // namespace

std::optional<Perigee> seed_helix(const Detector& detector, std::span<const Hit> hits,
                                  std::span<const std::int8_t> sides, SeedFrom from) {
  if (from == SeedFrom::azimuths) return seed_from_azimuths(detector, hits);
  std::optional<Circle> circle;
  double turn = 1;
  const bool known = std::ranges::any_of(sides, [](std::int8_t side) { return side != 0; });
  for (int pass = 0; pass < (known ? 2 : 1); ++pass) {
    const std::vector<Point> points =
        axial_points(detector, hits, sides, from, turn, circle ? &*circle : nullptr);
    circle = fit_circle(points);
    if (!circle) return std::nullopt;
    turn = turning(*circle, points.front(), points.back());
  }
  const double centre = std::hypot(circle->x, circle->y);
  if (centre == 0) return std::nullopt;
  const double to_closest = 1 - circle->radius / centre;
  const Point closest{circle->x * to_closest, circle->y * to_closest};
  const auto line = fit_line(detector, hits, sides, from, *circle, turn, Arc(*circle, turn, closest));
  if (!line) return std::nullopt;
  // The centre lies to the left of an anticlockwise flight.
  const double psi = std::atan2(-turn * circle->x, turn * circle->y);
  const double kappa = turn / circle->radius / curvature(detector.bz, 1.0);
  return Perigee{closest.x * std::sin(psi) - closest.y * std::cos(psi), psi, kappa, line->z0, line->tanl};
}

}  // namespace cgemit

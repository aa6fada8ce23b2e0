#include "reconstruction/fit/seed.hpp"

#include <array>
#include <cmath>

#include "common/angles.hpp"
#include "detector/strip_plane.hpp"
#include "kalman/vector.hpp"
#include "motion/helix.hpp"
#include "reconstruction/fit/annealed.hpp"
#include "reconstruction/fit/circle.hpp"
#include "reconstruction/fit/slow_seed.hpp"

namespace cgemit {

namespace {

constexpr double wire_error = 0.2, strip_error = 0.2;  // mm, including the effects that the circle neglects

// The transverse plane.
struct CircleShape {
  using Model = Circle;
  static constexpr std::size_t least = 3;
  struct Point {
    double x, y;
    DriftCircle drift_circle;
  };
  static double left(const Circle& circle, const Point& p) { return circle.left(p.x, p.y); }
  struct Sums {
    Moments moments;
    void add(const Point& p, const Circle* about, const Attraction& attraction) {
      Circle::Vector shift{0, 0};
      if (about != nullptr && attraction.offset != 0) shift = about->leftward(p.x, p.y);
      moments.add(p.x - attraction.offset * shift.x, p.y - attraction.offset * shift.y, attraction.weight);
    }
    std::optional<Circle> solve() const { return moments.circle(); }
  };
};

struct Line {
  double z0, tanl;
};

// z as a function of arc: a point lies to the left of the circle by g0 + g1 z + g2 z^2 where the track is at
// height z.
struct LineShape {
  using Model = Line;
  static constexpr std::size_t least = 2;
  struct Point {
    double s, g0, g1, g2;
    double reach;  // mm, largest possible |z| of the hit
    DriftCircle drift_circle;
    double at(double z) const { return g0 + z * (g1 + z * g2); }
  };
  static double left(const Line& line, const Point& p) { return p.at(line.z0 + line.tanl * p.s); }
  // Normal equations. A weak constraint to the origin keeps the slope through two close points finite.
  struct Sums {
    double n = 1 / (300.0 * 300.0), s1 = 0, s2 = 1e-9, z1 = 0, sz = 0;
    void add(const Point& p, const Line* about, const Attraction& attraction) {
      const double z =
          about != nullptr ? about->z0 + about->tanl * p.s : std::clamp(-p.g0 / p.g1, -p.reach, p.reach);
      const double slope = p.g1 + 2 * z * p.g2, value = attraction.offset - p.at(z) + slope * z;
      const double row = attraction.weight * slope;
      n += row * slope;
      s1 += row * slope * p.s;
      s2 += row * slope * p.s * p.s;
      z1 += row * value;
      sz += row * value * p.s;
    }
    std::optional<Line> solve() const {
      const double determinant = n * s2 - s1 * s1;
      if (!(determinant > 0)) return std::nullopt;
      return Line{(z1 * s2 - sz * s1) / determinant, (n * sz - s1 * z1) / determinant};
    }
  };
};

using CircleFit = Annealed<CircleShape>;
using LineFit = Annealed<LineShape>;

CircleFit::Result find_circle(const Detector& detector, std::span<const Hit> hits,
                              std::span<const std::int8_t> sides, SeedFrom from) {
  CircleFit fit;
  for (std::size_t i = 0; i < hits.size(); ++i) {
    const Hit& hit = hits[i];
    const auto index = static_cast<std::size_t>(hit.layer);
    if (hit.view == View::wire && detector.wires[index].twist == 0) {
      const Wire& wire = detector.wires[index].placed[static_cast<std::size_t>(hit.channel)];
      fit.add({wire.x, wire.y, {hit.value, static_cast<double>(sides[i]), 1 / wire_error, 1, 0}});
    } else if (hit.view == View::x && from == SeedFrom::wires_and_clusters) {
      const MeasuringLayer& layer = detector.layers[index];
      const double phi = azimuth(layer, hit.channel, hit.value), r = layer.r_mid();
      fit.add({r * std::cos(phi), r * std::sin(phi), {0, 1, 1 / strip_error, 1, 0}});
    }
  }
  return fit.result();
}

// At height z a stereo wire lies to the left of the circle by a quadratic in z.
LineShape::Point wire_point(const WireLayer& layer, const Hit& hit, double side, const Circle& circle,
                            double s, double error) {
  const Wire& wire = layer.placed[static_cast<std::size_t>(hit.channel)];
  const double gx = wire.ex / wire.ez, gy = wire.ey / wire.ez;
  const auto [nx, ny] = circle.gradient(wire.x, wire.y);
  return {s,
          circle.algebraic(wire.x, wire.y),
          nx * gx + ny * gy,
          -0.5 * circle.w * (gx * gx + gy * gy),
          layer.half_length,
          {hit.value, side, 1 / error, std::sqrt(gx * gx + gy * gy) / error, 0}};
}

// V strips, crossed at the X of their layer that is closest to the circle, or else at the circle itself.
LineShape::Point strip_point(const MeasuringLayer& layer, const Hit& hit, std::span<const Hit> before,
                             const HelixPoint& point, double s, double scale) {
  const double around = 2 * pi * layer.r_readout;
  double on_circle = local_x(layer, hit.channel, std::atan2(point.y, point.x)), x = on_circle;
  double closest = 10;  // mm
  bool measured = false;
  for (std::size_t i = before.size();
       i-- > 0 && before[i].layer == hit.layer && before[i].view != View::wire;) {
    if (before[i].view != View::x || before[i].channel != hit.channel) continue;
    const double off = before[i].value - on_circle,
                 distance = std::abs(off - around * std::round(off / around));
    if (distance >= closest) continue;
    closest = distance;
    x = before[i].value;
    measured = true;
  }
  const double v = hit.value + hit.k * hit.x;
  // Near the sheet's first edge X may be off by one turn; z then lies outside the layer.
  double z = crossing_z(layer, x, v);
  if (!measured && std::abs(z) > layer.half_length) {
    const double less = crossing_z(layer, x - around, v), more = crossing_z(layer, x + around, v);
    z = std::min({z, less, more}, [](double a, double b) { return std::abs(a) < std::abs(b); });
  }
  const double error = measured ? strip_error : strip_error * scale;
  return {s, -z * layer.sin_stereo, layer.sin_stereo,
          0, layer.half_length,     {0, 1, 1 / error, std::abs(layer.sin_stereo) / error, 0}};
}

LineFit::Result find_line(const Detector& detector, std::span<const Hit> hits,
                          std::span<const std::int8_t> sides, SeedFrom from, const Circle& circle,
                          double scale) {
  LineFit line;
  HelixPoint point{circle.x(), circle.y(), 0, circle.ux, circle.uy, 0, circle.w};
  double s = 0;
  for (std::size_t i = 0; i < hits.size(); ++i) {
    const Hit& hit = hits[i];
    const auto index = static_cast<std::size_t>(hit.layer);
    const bool stereo = hit.view == View::wire && detector.wires[index].twist != 0;
    const bool strips = hit.view == View::v && from == SeedFrom::wires_and_clusters;
    if (!stereo && !strips) continue;
    const double radius = stereo ? std::sqrt(detector.wires[index].waist) : detector.layers[index].r_mid();
    double step = 0;
    if (radius <= std::abs(circle.d) || !step_to_cylinder(point, radius, step)) continue;
    s += step;
    line.add(stereo ? wire_point(detector.wires[index], hit, sides[i], circle, s, wire_error * scale)
                    : strip_point(detector.layers[index], hit, hits.first(i), point, s, scale));
  }
  return line.result();
}

// Track from the beam line with azimuth psi0 + w r/2 and z = z0 + tanl r, through wires with azimuth phi +
// slope z: linear in (psi0, w/2, z0, tanl), with d = 0. For chambers with few axial layers.
std::optional<Perigee> seed_from_azimuths(const Detector& detector, std::span<const Hit> hits) {
  constexpr double error = 0.02;  // rad, half a cell
  // Weak constraints: curvature 1/300 mm, z0 300 mm, tanl 3.
  const auto weak = [](double sigma) { return error * error / (sigma * sigma); };
  Symmetric<double> normal = Symmetric<double>::diagonal({{1, 0, weak(1.0 / 300), weak(300.0), weak(3.0)}});
  Five<double> right = Five<double>::zero();
  double first = 0;
  int points = 0;
  for (const Hit& hit : hits) {
    if (hit.view != View::wire) continue;
    const WireLayer& layer = detector.wires[static_cast<std::size_t>(hit.layer)];
    const Wire& wire = layer.placed[static_cast<std::size_t>(hit.channel)];
    const double phi = std::atan2(wire.y, wire.x), r = std::sqrt(layer.waist);
    if (points == 0) first = phi;
    const double slope = layer.tan_half_twist / layer.half_length;
    const Five<double> row = {{0, 1, r, -slope, -slope * r}};
    normal.add([&](auto i, auto j) { return row[i] * row[j]; });
    right = right + wrap_angle(phi - first) * row;
    ++points;
  }
  if (points < 5) return std::nullopt;
  const Five<double> found = solve(normal, right);
  if (!std::isfinite(found[1] + found[2] + found[3] + found[4])) return std::nullopt;
  const double kappa = 2 * found[2] / curvature(detector.bz, 1.0);
  return Perigee{0, wrap_angle(first + found[1]), kappa, found[3], found[4]};
}

}  // namespace

std::optional<Seed> seed_helix(const Detector& detector, std::span<const Hit> hits,
                               std::span<const std::int8_t> sides, SeedFrom from, double mass) {
  if (hits.empty()) return std::nullopt;
  const auto radius = [&](const Hit& hit) {
    const auto index = static_cast<std::size_t>(hit.layer);
    return hit.view == View::wire ? std::sqrt(detector.wires[index].waist) : detector.layers[index].r_mid();
  };
  const double middle = 0.5 * (radius(hits.front()) + radius(hits.back()));
  if (from == SeedFrom::azimuths) {
    const auto helix = seed_from_azimuths(detector, hits);
    return helix ? std::optional(Seed{before_loss(detector, *helix, middle, mass), HUGE_VAL}) : std::nullopt;
  }
  const auto [circle, scale] = find_circle(detector, hits, sides, from);
  if (!circle) return std::nullopt;
  const auto line = find_line(detector, hits, sides, from, *circle, scale).model;
  if (!line) return std::nullopt;
  const double kappa = circle->w / curvature(detector.bz, 1.0);
  const Perigee helix{circle->d, std::atan2(circle->uy, circle->ux), kappa == 0 ? 1e-9 : kappa, line->z0,
                      line->tanl};
  return Seed{before_loss(detector, helix, middle, mass), wire_error * scale};
}

}  // namespace cgemit

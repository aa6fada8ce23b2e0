#include "reconstruction/fit/seed.hpp"

#include <array>
#include <cmath>

#include "common/angles.hpp"
#include "common/lanes/number.hpp"
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
  template <class T>
  struct Point {
    T x, y;
    DriftCircle<T> drift_circle;
  };
  template <class T>
  static T left(const Circle& circle, const Point<T>& p) {
    return circle.left(p.x, p.y);
  }
  template <class T>
  struct Sums {
    Moments<T> moments;
    void add(const Point<T>& p, const Circle* about, const Attraction<T>& attraction) {
      if (about == nullptr) return moments.add(p.x, p.y, attraction.weight);
      const auto [x, y] = about->leftward(p.x, p.y);
      moments.add(p.x - attraction.offset * x, p.y - attraction.offset * y, attraction.weight);
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
  template <class T>
  struct Point {
    T s, g0, g1, g2;
    T reach;  // mm, largest possible |z| of the hit
    DriftCircle<T> drift_circle;
    T at(const T& z) const { return g0 + z * (g1 + z * g2); }
  };
  template <class T>
  static T left(const Line& line, const Point<T>& p) {
    return p.at(line.z0 + line.tanl * p.s);
  }
  // Normal equations.
  template <class T>
  struct Sums {
    T n = 0.0, s1 = 0.0, s2 = 0.0, z1 = 0.0, sz = 0.0;
    void add(const Point<T>& p, const Line* about, const Attraction<T>& attraction) {
      const T z =
          about != nullptr ? about->z0 + about->tanl * p.s : smaller(larger(-p.g0 / p.g1, -p.reach), p.reach);
      const T slope = p.g1 + 2.0 * z * p.g2, value = attraction.offset - p.at(z) + slope * z;
      const T row = attraction.weight * slope;
      n += row * slope;
      s1 += row * slope * p.s;
      s2 += row * slope * p.s * p.s;
      z1 += row * value;
      sz += row * value * p.s;
    }
    std::optional<Line> solve() const {
      // A weak constraint to the origin keeps the slope through two close points finite.
      const double nn = sum(n) + 1 / (300.0 * 300.0), ns = sum(s1), ss = sum(s2) + 1e-9;
      const double nz = sum(z1), zs = sum(sz), determinant = nn * ss - ns * ns;
      if (!(determinant > 0)) return std::nullopt;
      return Line{(nz * ss - zs * ns) / determinant, (nn * zs - ns * nz) / determinant};
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
      fit.add({wire.x, wire.y, {hit.value, static_cast<double>(sides[i]), 1 / wire_error, 1}});
    } else if (hit.view == View::x && from == SeedFrom::wires_and_clusters) {
      const MeasuringLayer& layer = detector.layers[index];
      const double phi = azimuth(layer, hit.channel, hit.value), r = layer.r_mid();
      fit.add({r * std::cos(phi), r * std::sin(phi), {0, 1, 1 / strip_error, 1}});
    }
  }
  return fit.result();
}

// Stereo wires of one track, one per lane, each with the side on which the track passes it.
struct StereoWires {
  std::array<const WireLayer*, lanes_of<Number>> layers;
  std::array<const Wire*, lanes_of<Number>> wires;
  Number drift, side;
  int n = 0;

  void add(const WireLayer& layer, const Hit& hit, double known_side) {
    // Free lanes hold the last wire.
    for (int i = n; i < lanes_of<Number>; ++i) {
      layers[static_cast<std::size_t>(i)] = &layer;
      wires[static_cast<std::size_t>(i)] = &layer.placed[static_cast<std::size_t>(hit.channel)];
      set_lane(drift, i, hit.value);
      set_lane(side, i, known_side);
    }
    ++n;
  }

  // Adds those that the circle reaches. At height z a wire lies to the left of it by a quadratic in z.
  void add_to(LineFit& line, const Circle& circle, const HelixPoint& start, double error) const {
    const auto of = [](const auto& members, auto member) {
      return gathered<Number>([&](int i) { return member(*members[static_cast<std::size_t>(i)]); });
    };
    const Number radius = sqrt(of(layers, [](const WireLayer& layer) { return layer.waist; })),
                 reach = of(layers, [](const WireLayer& layer) { return layer.half_length; });
    const Number x = of(wires, [](const Wire& wire) { return wire.x; }),
                 y = of(wires, [](const Wire& wire) { return wire.y; }),
                 gx = of(wires, [](const Wire& wire) { return wire.ex / wire.ez; }),
                 gy = of(wires, [](const Wire& wire) { return wire.ey / wire.ez; });
    HelixPointOf<Number> point{start.x, start.y, 0.0, start.ux, start.uy, 0.0, start.w};
    Number s;
    mask_of<Number> reached = radius > std::abs(circle.d);
    reached = step_to_cylinder(point, radius, s, true, reached);
    const auto [nx, ny] = circle.gradient(x, y);
    const Number tilt = gx * gx + gy * gy;
    const LineShape::Point<Number> points{s,
                                          circle.algebraic(x, y),
                                          nx * gx + ny * gy,
                                          -0.5 * circle.w * tilt,
                                          reach,
                                          {drift, side, 1 / error, sqrt(tilt) / error}};
    for (int i = 0; i < n; ++i)
      if (lane(reached, i)) line.add(points, i);
  }
};

// V strips, crossed at the X of their layer that is closest to the circle, or else at the circle itself.
LineShape::Point<double> strip_point(const MeasuringLayer& layer, const Hit& hit, std::span<const Hit> before,
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
          0, layer.half_length,     {0, 1, 1 / error, std::abs(layer.sin_stereo) / error}};
}

LineFit::Result find_line(const Detector& detector, std::span<const Hit> hits,
                          std::span<const std::int8_t> sides, SeedFrom from, const Circle& circle,
                          double scale) {
  LineFit line;
  StereoWires wires;
  const HelixPoint start{circle.x(), circle.y(), 0, circle.ux, circle.uy, 0, circle.w};
  const auto add_wires = [&] {
    wires.add_to(line, circle, start, wire_error * scale);
    wires.n = 0;
  };
  for (std::size_t i = 0; i < hits.size(); ++i) {
    const Hit& hit = hits[i];
    const auto index = static_cast<std::size_t>(hit.layer);
    if (hit.view == View::wire && detector.wires[index].twist != 0) {
      wires.add(detector.wires[index], hit, sides[i]);
      if (wires.n == lanes_of<Number>) add_wires();
    } else if (hit.view == View::v && from == SeedFrom::wires_and_clusters) {
      const MeasuringLayer& layer = detector.layers[index];
      HelixPoint point = start;
      double s = 0;
      if (layer.r_mid() <= std::abs(circle.d) || !step_to_cylinder(point, layer.r_mid(), s)) continue;
      line.add(strip_point(layer, hit, hits.first(i), point, s, scale));
    }
  }
  if (wires.n > 0) add_wires();
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

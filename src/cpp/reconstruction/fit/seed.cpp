#include "reconstruction/fit/seed.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "common/angles.hpp"
#include "common/lanes/number.hpp"
#include "detector/strip_plane.hpp"
#include "kalman/vector.hpp"
#include "motion/helix.hpp"
#include "motion/views.hpp"
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
    T low, high;  // mm, ends of what measures the hit
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
          about != nullptr ? about->z0 + about->tanl * p.s : smaller(larger(-p.g0 / p.g1, p.low), p.high);
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

// All hits at once: a step from a helix, (d, psi, w, z0, tanl), in linear order.
struct StepShape {
  using Model = Five<double>;
  static constexpr std::size_t least = parameters + 1;
  template <class T>
  struct Point {
    T present;    // mm, distance to the left of the helix
    Five<T> row;  // its derivatives
    DriftCircle<T> drift_circle;
  };
  template <class T>
  static T left(const Five<double>& step, const Point<T>& p) {
    return p.present + p.row[0] * step[0] + p.row[1] * step[1] + p.row[2] * step[2] + p.row[3] * step[3] +
           p.row[4] * step[4];
  }
  template <class T>
  struct Sums {
    Symmetric<T> normal = Symmetric<T>::diagonal(Five<T>::zero());
    Five<T> right = Five<T>::zero();
    void add(const Point<T>& p, const Five<double>*, const Attraction<T>& attraction) {
      const Five<T> weighted = attraction.weight * p.row;
      normal.add([&](auto i, auto j) { return weighted[i] * p.row[j]; });
      right = right + (attraction.offset - p.present) * weighted;
    }
    std::optional<Five<double>> solve() const {
      // Weak constraints: 100 mm, 1 rad, 1/300 mm, 1 m, 3.
      Symmetric<double> total = Symmetric<double>::diagonal({{1e-4, 1, 9e4, 1e-6, 0.1}});
      for (std::size_t i = 0; i < total.v.size(); ++i) total.v[i] += sum(normal.v[i]);
      Five<double> step;
      unroll<parameters>([&](auto i) { step[i] = sum(right[i]); });
      step = cgemit::solve(total, step);
      if (!std::isfinite(step[0] + step[1] + step[2] + step[3] + step[4])) return std::nullopt;
      return step;
    }
  };
};

using CircleFit = Annealed<CircleShape>;
using LineFit = Annealed<LineShape>;
using StepFit = Annealed<StepShape>;

CircleFit::Result find_circle(const Detector& detector, std::span<const Hit> hits,
                              std::span<const std::int8_t> sides, SeedFrom from, int sign = 0) {
  CircleFit fit;
  for (std::size_t i = 0; i < hits.size(); ++i) {
    const Hit& hit = hits[i];
    const auto index = static_cast<std::size_t>(hit.layer);
    if (hit.view == View::wire && stereo_sign(detector.wires[index]) == sign) {
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

// Wires of one track, one per lane, each with the side on which the track passes it.
struct Wires {
  std::array<const WireLayer*, lanes_of<Number>> layers;
  std::array<const Wire*, lanes_of<Number>> wires;
  Number drift, side, channel;
  mask_of<Number> there;  // free lanes hold the last wire

  void set(int i, const WireLayer& layer, const Hit& hit, double known_side, bool is_there) {
    layers[static_cast<std::size_t>(i)] = &layer;
    wires[static_cast<std::size_t>(i)] = &layer.placed[static_cast<std::size_t>(hit.channel)];
    set_lane(drift, i, hit.value);
    set_lane(side, i, known_side);
    set_lane(channel, i, hit.channel);
    set_lane(there, i, is_there);
  }
  Number each(double WireLayer::* member) const {
    return gathered<Number>([&](int i) { return layers[static_cast<std::size_t>(i)]->*member; });
  }
  template <class Value>
  Number each(Value&& value) const {
    return gathered<Number>([&](int i) { return value(*layers[static_cast<std::size_t>(i)]); });
  }
  Number each(double Wire::* member) const {
    return gathered<Number>([&](int i) { return wires[static_cast<std::size_t>(i)]->*member; });
  }
};

// The wires of a track, or its stereo wires. Those beyond the capacity are ignored: they would not improve a
// first helix.
class WiresOfTrack {
 public:
  WiresOfTrack(const Detector& detector, std::span<const Hit> hits, std::span<const std::int8_t> sides,
               bool stereo) {
    const auto put = [&](std::size_t at, const WireLayer& layer, std::size_t i, bool there) {
      packs_[at / width].set(static_cast<int>(at % width), layer, hits[i], sides[i], there);
    };
    const WireLayer* layer = nullptr;
    std::size_t last = 0;
    for (std::size_t i = 0; i < hits.size() && n_ < width * packs_.size(); ++i) {
      if (hits[i].view != View::wire) continue;
      const WireLayer& its = detector.wires[static_cast<std::size_t>(hits[i].layer)];
      if (stereo && its.twist == 0) continue;
      put(n_++, its, i, true);
      layer = &its;
      last = i;
    }
    for (std::size_t at = n_; at % width != 0; ++at) put(at, *layer, last, false);
  }
  std::size_t size() const { return n_; }
  std::span<const Wires> packs() const { return std::span(packs_).first((n_ + width - 1) / width); }

 private:
  static constexpr std::size_t width = lanes_of<Number>;
  std::array<Wires, 128 / width> packs_;
  std::size_t n_ = 0;
};

// Adds the wires that a circle reaches. At height z a wire lies to the left of it by a quadratic in z.
void add_wires(const Wires& wires, const Circle& circle, double error, LineFit& line) {
  HelixPointOf<Number> point{circle.x(), circle.y(), 0.0, circle.ux, circle.uy, 0.0, circle.w};
  const Number radius = sqrt(wires.each(&WireLayer::waist)), x = wires.each(&Wire::x),
               y = wires.each(&Wire::y), per_ez = 1.0 / wires.each(&Wire::ez),
               gx = wires.each(&Wire::ex) * per_ez, gy = wires.each(&Wire::ey) * per_ez;
  Number s;
  const mask_of<Number> reached =
      step_to_cylinder(point, radius, s, true, wires.there & (radius > std::abs(circle.d)));
  const auto [nx, ny] = circle.gradient(x, y);
  const Number tilt = gx * gx + gy * gy;
  line.add({s,
            circle.algebraic(x, y),
            nx * gx + ny * gy,
            -0.5 * circle.w * tilt,
            wires.each([](const WireLayer& one) { return one.ends.low; }),
            wires.each([](const WireLayer& one) { return one.ends.high; }),
            {wires.drift, wires.side, 1 / error, sqrt(tilt) / error}},
           reached);
}

struct Crossing {
  HelixPoint point;
  double s;
};
// Where a circle leaves a cylinder.
std::optional<Crossing> crossing_of(const Circle& circle, double radius) {
  Crossing at{{circle.x(), circle.y(), 0, circle.ux, circle.uy, 0, circle.w}, 0};
  if (radius <= std::abs(circle.d) || !step_to_cylinder(at.point, radius, at.s)) return std::nullopt;
  return at;
}

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
  if (!measured && layer.ends.miss(z)) {
    const double less = crossing_z(layer, x - around, v), more = crossing_z(layer, x + around, v),
                 middle = layer.ends.middle();
    z = std::min({z, less, more},
                 [=](double a, double b) { return std::abs(a - middle) < std::abs(b - middle); });
  }
  const double error = measured ? strip_error : strip_error * scale;
  return {s,
          -z * layer.sin_stereo,
          layer.sin_stereo,
          0,
          layer.ends.low,
          layer.ends.high,
          {0, 1, 1 / error, std::abs(layer.sin_stereo) / error}};
}

LineFit::Result find_line(const Detector& detector, std::span<const Hit> hits,
                          std::span<const std::int8_t> sides, SeedFrom from, const Circle& circle,
                          double scale) {
  LineFit line;
  const WiresOfTrack stereo(detector, hits, sides, true);
  for (const Wires& wires : stereo.packs()) add_wires(wires, circle, wire_error * scale, line);
  for (std::size_t i = 0; i < hits.size(); ++i) {
    if (hits[i].view != View::v || from != SeedFrom::wires_and_clusters) continue;
    const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(hits[i].layer)];
    const auto crossing = crossing_of(circle, layer.r_mid());
    if (crossing) line.add(strip_point(layer, hits[i], hits.first(i), crossing->point, crossing->s, scale));
  }
  return line.result();
}

// kappa of a curvature; without a field that of a rigidity, p over the unsigned charge.
double kappa_of(const Detector& detector, double w, double tanl, double rigidity) {
  return is_straight(detector.bz) ? std::sqrt(1 + tanl * tanl) / rigidity : w / curvature(detector.bz, 1.0);
}

// The seed with the loss before the hits; not of a helix so close to a straight line that its curvature may
// be due to the errors of the hits.
Perigee corrected(const Detector& detector, const Perigee& helix, double middle, double mass, double charge) {
  constexpr double least_sagitta = 1;  // mm
  const bool bends = std::abs(curvature(detector.bz, helix.kappa)) * middle * middle > 2 * least_sagitta;
  return bends ? before_loss(detector, helix, middle, species_of(mass, charge, helix.kappa)) : helix;
}

// Track from the beam line with azimuth psi0 + w r/2 and z = z0 + tanl r, through wires with azimuth phi +
// slope z: linear in (psi0, w/2, z0, tanl), with d = 0. For chambers with few axial layers. Where the track
// bends much, azimuth and arc are corrected with the result: arcsin(w r/2) in place of w r/2.
std::optional<Perigee> seed_from_azimuths(const Detector& detector, const WiresOfTrack& wires,
                                          double rigidity) {
  constexpr double error = 0.02;               // rad, half a cell
  constexpr double little = 0.2, most = 0.95;  // of w r/2
  // Weak constraints: curvature 1/300 mm, z0 300 mm, tanl 3.
  const auto weak = [](double sigma) { return error * error / (sigma * sigma); };
  if (wires.size() < 5) return std::nullopt;
  const auto azimuth = [](const Wires& some) {  // at z = 0
    return some.each(&WireLayer::phi_east) - 0.5 * some.each(&WireLayer::twist) +
           some.channel / some.each(&WireLayer::per_radian) -
           some.each(&WireLayer::twist_per_z) * some.each(&WireLayer::middle);
  };
  const double first = lane(azimuth(wires.packs().front()), 0);
  Five<double> found = Five<double>::zero();
  for (int pass = 0; pass < 2; ++pass) {
    Symmetric<Number> normal = Symmetric<Number>::diagonal(Five<Number>::zero());
    Five<Number> right = Five<Number>::zero();
    for (const Wires& some : wires.packs()) {
      const Number r = sqrt(some.each(&WireLayer::waist)), slope = some.each(&WireLayer::twist_per_z);
      const Number half = smaller(larger(found[2] * r, -most), most), inner = sqrt(1.0 - half * half);
      const Number longer = atan_over(half / inner) / inner;  // the arc over the chord
      const Number off = azimuth(some) - first - half * (longer - 1.0),
                   wrapped = off - (2 * pi) * nearest(off * (0.5 / pi));
      const Number weight = select(some.there, Number(1.0), Number(0.0));
      const Five<Number> row = {{0.0, 1.0, r, -slope, -slope * r * longer}};
      normal.add([&](auto i, auto j) { return weight * row[i] * row[j]; });
      right = right + weight * wrapped * row;
    }
    Symmetric<double> total = Symmetric<double>::diagonal({{1, 0, weak(1.0 / 300), weak(300.0), weak(3.0)}});
    for (std::size_t i = 0; i < total.v.size(); ++i) total.v[i] += sum(normal.v[i]);
    Five<double> sums;
    unroll<parameters>([&](auto i) { sums[i] = sum(right[i]); });
    found = solve(total, sums);
    if (!std::isfinite(found[1] + found[2] + found[3] + found[4])) return std::nullopt;
    if (std::abs(found[2]) * std::sqrt(wires.packs().back().layers.back()->waist) < little) break;
  }
  const double kappa = kappa_of(detector, 2 * found[2], found[4], rigidity);
  return Perigee{0, wrap_angle(first + found[1]), kappa, found[3], found[4]};
}

// The helix of the circles of both stereo signs, each through the wires where they are at z = 0. For tracks
// that turn back in the chamber: they cross several cells of a layer, whose azimuths tell nothing there.
std::optional<Perigee> seed_from_views(const Detector& detector, std::span<const Hit> hits,
                                       std::span<const std::int8_t> sides, double rigidity) {
  if (std::ranges::count(detector.wires, 0.0, &WireLayer::twist) >= 3) return std::nullopt;
  std::array<ViewCircle, 2> views;
  for (std::size_t i = 0; i < 2; ++i) {
    const auto circle = find_circle(detector, hits, sides, SeedFrom::wires, i == 0 ? 1 : -1).model;
    if (!circle) return std::nullopt;
    views[i] = {circle->d, std::atan2(circle->uy, circle->ux), circle->w};
  }
  double from = HUGE_VAL, to = 0;
  for (const Hit& hit : hits) {
    if (hit.view != View::wire) continue;
    const double r = std::sqrt(detector.wires[static_cast<std::size_t>(hit.layer)].waist);
    from = std::min(from, r);
    to = std::max(to, r);
  }
  const auto helix = helix_of_views(detector, views[0], views[1], from, to);
  if (!helix) return std::nullopt;
  const double kappa = kappa_of(detector, helix->w, helix->tanl, rigidity);
  return Perigee{helix->d, helix->psi, kappa == 0 ? 1e-9 : kappa, helix->z0, helix->tanl};
}

// What a helix, with this circle and line, passes at (x + gx z, y + gy z), to linear order in a step of it.
template <class T>
StepShape::Point<T> step_point(const Circle& c, double z0, double tanl, const T& at_x, const T& at_y,
                               const T& gx, const T& gy, const DriftCircle<T>& drift_circle) {
  T x = at_x, y = at_y, s, sine, cosine;
  for (int pass = 0; pass < 2; ++pass) {  // the arc needs the wire's place at the height of the track
    const T dx = x - c.x(), dy = y - c.y();
    const T ahead = dx * c.ux + dy * c.uy, across = 1.0 - c.w * (dy * c.ux - dx * c.uy);
    const T per_reach = 1.0 / sqrt(c.w * c.w * ahead * ahead + across * across);
    sine = ahead * per_reach;  // of the angle turned, over w
    cosine = across * per_reach;
    s = choose(
        cosine > 0.0, [&] { return ahead / across * atan_over(c.w * ahead / across); },
        [&] { return atan2(c.w * ahead, across) / c.w; });
    const T z = z0 + tanl * s;
    x = at_x + z * gx;
    y = at_y + z * gy;
  }
  const auto [nx, ny] = c.leftward(x, y);
  const T slope = gx * nx + gy * ny;
  return {c.left(x, y), {{cosine, -sine, -sine * sine / (1.0 + cosine), slope, slope * s}}, drift_circle};
}

// The helix near a first one that agrees with most of the hits. Empty if it misses many of them.
std::optional<Seed> seed_near(const Detector& detector, std::span<const Hit> hits, const WiresOfTrack& wires,
                              const Perigee& from, double rigidity) {
  constexpr double sharp = 3;  // wire errors
  const Circle circle{curvature(detector.bz, from.kappa), from.d, std::cos(from.psi), std::sin(from.psi)};
  StepFit fit;
  for (const Wires& some : wires.packs()) {  // before the strips: they then fill the lanes as they are
    const Number per_ez = 1.0 / some.each(&Wire::ez);
    fit.add(step_point(circle, from.z0, from.tanl, some.each(&Wire::x), some.each(&Wire::y),
                       some.each(&Wire::ex) * per_ez, some.each(&Wire::ey) * per_ez,
                       DriftCircle<Number>{some.drift, some.side, 1 / wire_error, 1.0}),
            some.there);
  }
  for (std::size_t i = 0; i < hits.size(); ++i) {
    const Hit& hit = hits[i];
    if (hit.view == View::wire) continue;
    const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(hit.layer)];
    const double r = layer.r_mid();
    if (hit.view == View::x) {
      const double phi = azimuth(layer, hit.channel, hit.value);
      fit.add(step_point(circle, from.z0, from.tanl, r * std::cos(phi), r * std::sin(phi), 0.0, 0.0,
                         DriftCircle<double>{0, 1, 1 / strip_error, 1}));
    } else if (const auto crossing = crossing_of(circle, r)) {
      const LineShape::Point<double> v =
          strip_point(layer, hit, hits.first(i), crossing->point, crossing->s, 1);
      fit.add({v.at(from.z0 + from.tanl * v.s), {{0, 0, 0, v.g1, v.g1 * v.s}}, v.drift_circle});
    }
  }
  const auto [step, scale] = fit.near(Five<double>::zero());
  if (!step || !(scale < sharp)) return std::nullopt;
  const double tanl = from.tanl + (*step)[4];
  const double kappa = is_straight(detector.bz) ? kappa_of(detector, 0, tanl, rigidity)
                                                : from.kappa + (*step)[2] / curvature(detector.bz, 1.0);
  return Seed{{from.d + (*step)[0], wrap_angle(from.psi + (*step)[1]), kappa == 0 ? 1e-9 : kappa,
               from.z0 + (*step)[3], tanl},
              wire_error * scale};
}

}  // namespace

std::optional<Seed> seed_helix(const Detector& detector, std::span<const Hit> hits,
                               std::span<const std::int8_t> sides, SeedFrom from, double mass, double charge,
                               double momentum) {
  if (hits.empty()) return std::nullopt;
  const double rigidity = momentum / charge;
  const auto radius = [&](const Hit& hit) {
    const auto index = static_cast<std::size_t>(hit.layer);
    return hit.view == View::wire ? std::sqrt(detector.wires[index].waist) : detector.layers[index].r_mid();
  };
  const double middle = 0.5 * (radius(hits.front()) + radius(hits.back()));
  if (from == SeedFrom::azimuths) {
    const WiresOfTrack wires(detector, hits, sides, false);
    const auto first = seed_from_azimuths(detector, wires, rigidity);
    auto found = first ? seed_near(detector, hits, wires, *first, rigidity) : std::nullopt;
    const auto other = found ? std::nullopt : seed_from_views(detector, hits, sides, rigidity);
    if (other) found = seed_near(detector, hits, wires, *other, rigidity);
    if (other && found) found->spread = HUGE_VAL;  // sides are not taken from it
    if (!found && !first && !other) return std::nullopt;
    const Seed seed = found.value_or(Seed{first ? *first : *other, HUGE_VAL});
    return Seed{corrected(detector, seed.helix, middle, mass, charge), seed.spread};
  }
  const auto [circle, scale] = find_circle(detector, hits, sides, from);
  if (!circle) return std::nullopt;
  const auto line = find_line(detector, hits, sides, from, *circle, scale).model;
  if (!line) return std::nullopt;
  const double kappa = kappa_of(detector, circle->w, line->tanl, rigidity);
  const Perigee helix{circle->d, std::atan2(circle->uy, circle->ux), kappa == 0 ? 1e-9 : kappa, line->z0,
                      line->tanl};
  return Seed{corrected(detector, helix, middle, mass, charge), wire_error * scale};
}

}  // namespace cgemit

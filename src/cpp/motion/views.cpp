#include "motion/views.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "common/angles.hpp"

namespace cgemit {

namespace {

constexpr int radii = 5;  // at which two circles are compared

// 1/mm, |turning| per height of the wires of one sign, between layers by their distance.
double turn_at(const Detector& detector, int sign, double r) {
  const WireLayer *below = nullptr, *above = nullptr;
  for (const WireLayer& layer : detector.wires) {
    if (stereo_sign(layer) != sign) continue;
    if (layer.waist > r * r) {
      above = &layer;
      break;
    }
    below = &layer;
  }
  if (below == nullptr || above == nullptr) return std::abs((below == nullptr ? above : below)->twist_per_z);
  const double low = std::sqrt(below->waist), high = std::sqrt(above->waist), part = (r - low) / (high - low);
  return std::abs(below->twist_per_z + part * (above->twist_per_z - below->twist_per_z));
}

// The azimuth at which a circle leaves a cylinder.
std::optional<double> azimuth_at(const ViewCircle& circle, double r) {
  const double ux = std::cos(circle.psi), uy = std::sin(circle.psi);
  HelixPoint at{circle.d * uy, -circle.d * ux, 0, ux, uy, 0, circle.w};
  double arc = 0;
  if (std::abs(circle.d) >= r || !step_to_cylinder(at, r, arc)) return std::nullopt;
  return std::atan2(at.y, at.x);
}

}  // namespace

HelixPoint circle_through(double ax, double ay, double bx, double by, double cx, double cy) {
  const double abx = bx - ax, aby = by - ay, acx = cx - ax, acy = cy - ay;
  const double ab = std::hypot(abx, aby), ac = std::hypot(acx, acy), bc = std::hypot(cx - bx, cy - by);
  const double w = 2 * (abx * acy - aby * acx) / (ab * ac * bc);
  const double half = std::asin(std::clamp(0.5 * w * ac, -1.0, 1.0));
  const double psi = std::atan2(acy, acx) - half;
  return {ax, ay, 0, std::cos(psi), std::sin(psi), 0, w};
}

double arc_of(double w, double chord) {
  const double sine = std::clamp(0.5 * w * chord, -1.0, 1.0);
  return std::abs(sine) < 1e-6 ? chord : 2 * std::asin(sine) / w;
}

std::optional<ViewHelix> helix_of_views(const Detector& detector, const ViewCircle& positive,
                                        const ViewCircle& negative, double from, double to) {
  struct Point {
    double x, y, z;
  };
  std::array<Point, radii> points;
  std::size_t n = 0;
  for (int i = 0; i < radii; ++i) {
    const double r = from + i * (to - from) / (radii - 1);
    const auto one = azimuth_at(positive, r), other = azimuth_at(negative, r);
    if (!one || !other) continue;
    const double turn = turn_at(detector, 1, r), both = turn + turn_at(detector, -1, r);
    const double apart = wrap_angle(*other - *one), phi = *one + apart * turn / both;
    points[n++] = {r * std::cos(phi), r * std::sin(phi), apart / both};
  }
  if (n < 3) return std::nullopt;
  const Point &low = points[0], &middle = points[n / 2], &high = points[n - 1];
  const HelixPoint at = circle_through(low.x, low.y, middle.x, middle.y, high.x, high.y);
  if (at.outward() < 0) return std::nullopt;
  const PivotApproach line = approach_pivot(at, 0, 0);
  if (!line.exists) return std::nullopt;
  double s1 = 0, s2 = 0, z1 = 0, sz = 0;
  std::array<double, radii> arcs;
  for (std::size_t i = 0; i < n; ++i) {
    const double s = -line.arc + arc_of(at.w, std::hypot(points[i].x - low.x, points[i].y - low.y));
    arcs[i] = s;
    s1 += s;
    s2 += s * s;
    z1 += points[i].z;
    sz += s * points[i].z;
  }
  const auto count = static_cast<double>(n);
  const double determinant = count * s2 - s1 * s1;
  if (!(determinant > 0)) return std::nullopt;
  ViewHelix helix{line.d,
                  wrap_angle(std::atan2(at.uy, at.ux) + line.turn),
                  at.w,
                  (z1 * s2 - sz * s1) / determinant,
                  (count * sz - s1 * z1) / determinant,
                  0};
  for (std::size_t i = 0; i < n; ++i)
    helix.off = std::max(helix.off, std::abs(points[i].z - helix.z0 - helix.tanl * arcs[i]));
  return helix;
}

}  // namespace cgemit

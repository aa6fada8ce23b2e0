#include "reconstruction/find/views.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <bit>
#include <cmath>
#include <tuple>

#include "common/angles.hpp"
#include "motion/helix.hpp"
#include "reconstruction/find/score.hpp"
#include "reconstruction/find/segments.hpp"

namespace cgemit {

namespace {

constexpr int radii = 5;             // at which two circles are compared
constexpr double off_line = 150;     // mm of z, of a point between two circles from a line
constexpr double beyond_end = 50;    // mm, of a wire
constexpr double hit_error = 0.3;    // mm, with what the helix neglects
constexpr int fewest_layers = 3;     // of each view
constexpr double least_share = 0.6;  // of the layers of a view that the helix spans
// mm, at which hits count: the first helix is as uncertain as the heights between two circles. Hits of others
// count where it is sharp.
constexpr std::array<double, 7> windows{25, 15, 8, 4, 2, 1.5, 1.2};
constexpr double sharp = 2;

double inner_radius(const Detector& detector, const FoundCircle& circle, const EventHits& hits) {
  return std::sqrt(detector.wires[static_cast<std::size_t>(hits[circle.hits.front()].layer)].waist);
}
double outer_radius(const Detector& detector, const FoundCircle& circle, const EventHits& hits) {
  return std::sqrt(detector.wires[static_cast<std::size_t>(hits[circle.hits.back()].layer)].waist);
}

// The azimuth at which a circle leaves a cylinder.
std::optional<double> azimuth_at(const FoundCircle& circle, double r) {
  const double ux = std::cos(circle.psi), uy = std::sin(circle.psi);
  HelixPoint at{circle.d * uy, -circle.d * ux, 0, ux, uy, 0, circle.w};
  double arc = 0;
  if (std::abs(circle.d) >= r || !step_to_cylinder(at, r, arc)) return std::nullopt;
  return std::atan2(at.y, at.x);
}

}  // namespace

ViewSearch::ViewSearch(const Detector& detector, const FindSettings& settings)
    : detector_(detector),
      settings_(settings),
      views_{View(detector, settings, 1), View(detector, settings, -1)} {
  for (View& view : views_)
    for (const WireLayer& layer : detector.wires) {
      if (!view.hits.has(layer)) continue;
      view.radii.push_back(std::sqrt(layer.waist));
      view.turns.push_back(std::abs(layer.twist_per_z));
    }
}

// Between layers, that of neighbours by their distance.
double ViewSearch::View::turn(double r) const {
  const auto next = static_cast<std::size_t>(std::ranges::upper_bound(radii, r) - radii.begin());
  if (next == 0) return turns.front();
  if (next == radii.size()) return turns.back();
  const double part = (r - radii[next - 1]) / (radii[next] - radii[next - 1]);
  return turns[next - 1] + part * (turns[next] - turns[next - 1]);
}

const std::vector<ViewSeed>& ViewSearch::find(const EventHits& hits, bool displaced) {
  boxes_cut_ = segments_cut_ = false;
  seeds_.clear();
  for (View& view : views_) circles(view, hits, displaced);
  for (std::size_t i = 0; i < views_[0].circles.size(); ++i)
    for (std::size_t k = 0; k < views_[1].circles.size(); ++k) {
      const FoundCircle &a = views_[0].circles[i], &b = views_[1].circles[k];
      const auto first = together(a, b, hits);
      if (!first) continue;
      auto seed = refined(*first, a, b, hits);
      if (!seed) continue;
      seed->circles = {i, k};
      seeds_.push_back(std::move(*seed));
    }
  std::ranges::sort(seeds_, [](const ViewSeed& a, const ViewSeed& b) {
    return std::tuple(a.seed.rank, a.wires) < std::tuple(b.seed.rank, b.wires);
  });
  assign();
  return sorted_;
}

// Two neighbouring tracks are, with their circles exchanged, two others that may have about as many layers:
// the pair with the better sum is chosen.
void ViewSearch::assign() {
  const std::size_t n = views_[0].circles.size(), m = views_[1].circles.size();
  pair_.assign(n * m, -1);
  for (std::size_t i = 0; i < seeds_.size(); ++i)
    pair_[seeds_[i].circles[0] * m + seeds_[i].circles[1]] = static_cast<std::int32_t>(i);
  is_used_.assign(n + m, 0);
  chosen_.clear();
  for (std::size_t i = 0; i < seeds_.size(); ++i) {
    auto &first = is_used_[seeds_[i].circles[0]], &second = is_used_[n + seeds_[i].circles[1]];
    if (first != 0 || second != 0) continue;
    first = second = 1;
    chosen_.push_back(i);
  }
  const auto rank = [this](std::size_t seed) { return seeds_[seed].seed.rank; };
  for (std::size_t i = 0; i < chosen_.size(); ++i)
    for (std::size_t k = 0; k < i; ++k) {
      const auto &first = seeds_[chosen_[i]].circles, &second = seeds_[chosen_[k]].circles;
      const std::int32_t one = pair_[first[0] * m + second[1]], other = pair_[second[0] * m + first[1]];
      if (one < 0 || other < 0) continue;
      const auto e = static_cast<std::size_t>(one), f = static_cast<std::size_t>(other);
      if (rank(e) + rank(f) >= rank(chosen_[i]) + rank(chosen_[k])) continue;
      chosen_[i] = e;
      chosen_[k] = f;
    }
  std::ranges::sort(chosen_);
  sorted_.clear();
  is_used_.assign(seeds_.size(), 0);
  for (const std::size_t i : chosen_) {
    is_used_[i] = 1;
    sorted_.push_back(seeds_[i]);
  }
  for (std::size_t i = 0; i < seeds_.size(); ++i)
    if (is_used_[i] == 0) sorted_.push_back(std::move(seeds_[i]));
}

void ViewSearch::circles(View& view, const EventHits& hits, bool displaced) {
  view.circles.clear();
  view.hits.load(hits);
  view.axial.start();
  const auto collect = [&](auto& search) {
    while (view.circles.size() < static_cast<std::size_t>(settings_.max_seeds)) {
      auto circle = search.next();
      if (!circle) return;
      view.circles.push_back(std::move(*circle));
    }
  };
  collect(view.axial);
  boxes_cut_ = boxes_cut_ || view.axial.is_cut();
  if (!displaced) return;
  view.hits.load(hits);  // anew: parts of displaced tracks are circles from the beam line, too
  view.displaced.start(hits);
  segments_cut_ = segments_cut_ || view.displaced.is_cut();
  collect(view.displaced);
}

// Where two circles are at a radius.
auto ViewSearch::between(const FoundCircle& a, const FoundCircle& b, double r) const -> std::optional<Point> {
  const auto phi_a = azimuth_at(a, r), phi_b = azimuth_at(b, r);
  if (!phi_a || !phi_b) return std::nullopt;
  const double turn_a = views_[0].turn(r), turn_b = views_[1].turn(r), both = turn_a + turn_b;
  const double apart = wrap_angle(*phi_b - *phi_a), phi = *phi_a + apart * turn_a / both;
  return Point{r * std::cos(phi), r * std::sin(phi), apart / both};
}

// The helix of two circles, if they belong to one: heights on a line.
auto ViewSearch::together(const FoundCircle& a, const FoundCircle& b, const EventHits& hits) const
    -> std::optional<Helix> {
  double from = std::max(inner_radius(detector_, a, hits), inner_radius(detector_, b, hits)),
         to = std::min(outer_radius(detector_, a, hits), outer_radius(detector_, b, hits));
  if (to < 1.2 * from) {
    from = std::min(inner_radius(detector_, a, hits), inner_radius(detector_, b, hits));
    to = std::max(outer_radius(detector_, a, hits), outer_radius(detector_, b, hits));
  }
  std::array<Point, radii> points;
  std::size_t n = 0;
  for (int i = 0; i < radii; ++i)
    if (const auto point = between(a, b, from + i * (to - from) / (radii - 1))) points[n++] = *point;
  if (n < 3) return std::nullopt;
  const Point &low = points[0], &middle = points[n / 2], &high = points[n - 1];
  const HelixPoint at = circle_through(low.x, low.y, middle.x, middle.y, high.x, high.y);
  if (at.outward() < 0) return std::nullopt;
  const PivotApproach line = approach_pivot(at, 0, 0);
  if (!line.exists) return std::nullopt;
  double one = 0, s1 = 0, s2 = 0, z1 = 0, sz = 0;
  std::array<double, radii> arcs;
  for (std::size_t i = 0; i < n; ++i) {
    const double s = -line.arc + arc_of(at.w, std::hypot(points[i].x - low.x, points[i].y - low.y));
    arcs[i] = s;
    one += 1;
    s1 += s;
    s2 += s * s;
    z1 += points[i].z;
    sz += s * points[i].z;
  }
  const double determinant = one * s2 - s1 * s1;
  if (!(determinant > 0)) return std::nullopt;
  const double z0 = (z1 * s2 - sz * s1) / determinant, tanl = (one * sz - s1 * z1) / determinant;
  for (std::size_t i = 0; i < n; ++i)
    if (std::abs(points[i].z - z0 - tanl * arcs[i]) > off_line) return std::nullopt;
  if (std::abs(z0) > settings_.max_z + off_line || std::abs(line.d) > views_[0].hits.max_d())
    return std::nullopt;
  return Helix{line.d, wrap_angle(std::atan2(at.uy, at.ux) + line.turn), at.w, z0, tanl};
}

// Least squares of all five parameters to the wires of both circles near the helix, one window after the
// other.
std::optional<ViewSeed> ViewSearch::refined(Helix helix, const FoundCircle& a, const FoundCircle& b,
                                            const EventHits& hits) {
  of_circles_.assign(static_cast<std::size_t>(hits.size()), 0);
  for (const FoundCircle* circle : {&a, &b})
    for (const std::int32_t id : circle->hits) of_circles_[static_cast<std::size_t>(id)] = 1;
  using Vector = Eigen::Matrix<double, 5, 1>;
  using Matrix = Eigen::Matrix<double, 5, 5>;
  ViewSeed found{{}, 0, 0, {}, {}};
  double chi2 = 0;
  Matrix normal;
  for (const double window : windows) {
    normal = Vector(1e-6, 1e-2, 1e-2, 1e-6, 1e-2).asDiagonal();
    Vector right = Vector::Zero();
    const double ux = std::cos(helix.psi), uy = std::sin(helix.psi), n = 1 - helix.w * helix.d;
    const HelixPoint start{helix.d * uy, -helix.d * ux, 0, ux, uy, 0, helix.w};
    found.wires.clear();
    found.layers = 0;
    chi2 = 0;
    std::int32_t last = -1;
    for (std::int32_t id = hits.first_wire(); id < hits.size(); ++id) {
      if (hits.is_taken(id) || (window > sharp && of_circles_[static_cast<std::size_t>(id)] == 0)) continue;
      const Hit& hit = hits[id];
      const WireLayer& layer = detector_.wires[static_cast<std::size_t>(hit.layer)];
      const Wire& wire = layer.placed[static_cast<std::size_t>(hit.channel)];
      if (wire.x * ux + wire.y * uy < 0) continue;
      const double gx = wire.ex / wire.ez, gy = wire.ey / wire.ez;
      PivotApproach at = approach_pivot(start, wire.x, wire.y);
      double z = helix.z0 + helix.tanl * at.arc, x = wire.x + gx * z, y = wire.y + gy * z;
      at = approach_pivot(start, x, y);
      z = helix.z0 + helix.tanl * at.arc;
      if (!at.exists || at.arc < 0 || std::abs(z) > layer.half_length + beyond_end) continue;
      x = wire.x + gx * z;
      y = wire.y + gy * z;
      const double along = x * ux + y * uy, across = y * ux - x * uy, squares = x * x + y * y;
      const double g = n * across + helix.d * (1 - 0.5 * helix.w * helix.d) - 0.5 * helix.w * squares;
      const double left = g / (1 - 0.5 * helix.w * g);
      const double off = std::copysign(std::max(hit.value, 0.0), left) - left;
      if (std::abs(off) > window) continue;
      const double slope =
          (-n * uy - helix.w * x) * gx + (n * ux - helix.w * y) * gy;  // of the distance with the height
      Vector row;
      row << 1 - helix.w * (across + helix.d), -n * along,
          -helix.d * across - 0.5 * helix.d * helix.d - 0.5 * squares, slope, slope * at.arc;
      const double weight = 1 / (hit_error * hit_error + 0.01 * window * window);
      normal += weight * row * row.transpose();
      right += weight * off * row;
      chi2 += weight * off * off;
      found.wires.push_back(id);
      if (hit.layer != last) ++found.layers;
      last = hit.layer;
    }
    if (found.layers < 5) return std::nullopt;
    const Vector step = normal.inverse() * right;
    if (!step.allFinite()) return std::nullopt;
    helix.d += step[0];
    helix.psi = wrap_angle(helix.psi + step[1]);
    helix.w += step[2];
    helix.z0 += step[3];
    helix.tanl += step[4];
  }
  // A circle of one track with a wrong one has hits in few layers of the other view.
  const std::int32_t begin = hits[found.wires.front()].layer, end = hits[found.wires.back()].layer;
  for (const View& view : views_) {
    int layers = 0, spanned = 0;
    std::size_t next = 0;
    for (std::int32_t layer = begin; layer <= end; ++layer) {
      const bool here = view.hits.has(detector_.wires[static_cast<std::size_t>(layer)]);
      bool any = false;
      for (; next < found.wires.size() && hits[found.wires[next]].layer == layer; ++next) any = true;
      spanned += here ? 1 : 0;
      layers += here && any ? 1 : 0;
    }
    if (layers < fewest_layers || layers < least_share * spanned) return std::nullopt;
  }
  if (std::abs(helix.w) > 1.15 * views_[0].hits.largest_w() || std::abs(helix.d) > settings_.max_d ||
      std::abs(helix.z0) > settings_.max_z)
    return std::nullopt;
  const double per_kappa = curvature(detector_.bz, 1.0), kappa = helix.w / per_kappa;
  found.seed.helix = {helix.d, helix.psi, kappa == 0 ? 1e-9 : kappa, helix.z0, helix.tanl};
  found.radius = std::sqrt(detector_.wires[static_cast<std::size_t>(hits[found.wires.front()].layer)].waist);
  // The search has seen the hits already, and neglects scattering and loss.
  constexpr double caution = 6;
  const Matrix inverse = normal.inverse();
  const Vector scale(1, 1, 1 / per_kappa, 1, 1);
  Symmetric<double>& c = found.seed.covariance;
  c = Symmetric<double>::diagonal(Five<double>::zero());
  for (int i = 0; i < static_cast<int>(parameters); ++i)
    for (int j = i; j < static_cast<int>(parameters); ++j)
      c(i, j) = caution * scale[i] * scale[j] * inverse(i, j);
  const double bend = 1 + kappa * kappa;
  const std::array<double, parameters> floors{0.1, 1e-6 * bend, 4e-4 * kappa * kappa, 4, 1e-6 * bend};
  for (int i = 0; i < static_cast<int>(parameters); ++i) c(i, i) += floors[static_cast<std::size_t>(i)];
  // Two tracks from one point are, with their circles exchanged, two others from elsewhere.
  constexpr double per_layer = 4;
  found.seed.rank = 0.5 * chi2 - per_layer * found.layers -
                    log_prompt(found.seed.helix, c, settings_.max_d, settings_.max_z);
  return found;
}

}  // namespace cgemit

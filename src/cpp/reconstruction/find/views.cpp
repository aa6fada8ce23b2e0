#include "reconstruction/find/views.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <bit>
#include <cmath>
#include <tuple>
#include <utility>

#include "common/angles.hpp"
#include "motion/helix.hpp"
#include "reconstruction/find/score.hpp"

namespace cgemit {

namespace {

constexpr double off_line = 150;     // mm of z, of a point between two circles from a line
constexpr double beyond_end = 50;    // mm, of a wire
constexpr double view_error = 0.3;   // mm, with what the helix neglects
constexpr int fewest_of_view = 3;    // of each view
constexpr double least_share = 0.6;  // of the layers of a view that the helix spans
// mm, at which hits count: the first helix is as uncertain as the heights between two circles. Hits of others
// count where it is sharp.
constexpr std::array<double, 7> view_windows{25, 15, 8, 4, 2, 1.5, 1.2};
constexpr double sharp = 2;

}  // namespace

ViewSearch::ViewSearch(const Detector& detector, const FindSettings& settings)
    : detector_(detector),
      settings_(settings),
      views_{View(detector, settings, 1), View(detector, settings, -1)} {}

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

// The helix of two circles, if they belong to one: heights on a line.
std::optional<ViewHelix> ViewSearch::together(const FoundCircle& a, const FoundCircle& b,
                                              const EventHits& hits) const {
  const auto radius = [&](std::int32_t id) {
    return std::sqrt(detector_.wires[static_cast<std::size_t>(hits[id].layer)].waist);
  };
  const auto [a_in, a_out] = std::pair(radius(a.hits.front()), radius(a.hits.back()));
  const auto [b_in, b_out] = std::pair(radius(b.hits.front()), radius(b.hits.back()));
  constexpr double apart = 1.2;  // ratio of radii between which both have hits; else both are continued
  const bool overlap = std::min(a_out, b_out) > apart * std::max(a_in, b_in);
  const double from = overlap ? std::max(a_in, b_in) : std::min(a_in, b_in),
               to = overlap ? std::min(a_out, b_out) : std::max(a_out, b_out);
  const auto helix = helix_of_views(detector_, {a.d, a.psi, a.w}, {b.d, b.psi, b.w}, from, to);
  if (!helix || helix->off > off_line || std::abs(helix->z0) > settings_.max_z + off_line ||
      std::abs(helix->d) > views_[0].hits.max_d())
    return std::nullopt;
  return helix;
}

// Least squares of all five parameters to the wires of both circles near the helix, one window after the
// other.
std::optional<ViewSeed> ViewSearch::refined(ViewHelix helix, const FoundCircle& a, const FoundCircle& b,
                                            const EventHits& hits) {
  of_circles_.assign(static_cast<std::size_t>(hits.size()), 0);
  for (const FoundCircle* circle : {&a, &b})
    for (const std::int32_t id : circle->hits) of_circles_[static_cast<std::size_t>(id)] = 1;
  using Vector = Eigen::Matrix<double, 5, 1>;
  using Matrix = Eigen::Matrix<double, 5, 5>;
  ViewSeed found{{}, 0, 0, {}, {}};
  double chi2 = 0;
  Matrix normal;
  for (const double window : view_windows) {
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
      const double weight = 1 / (view_error * view_error + 0.01 * window * window);
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
    if (layers < fewest_of_view || layers < least_share * spanned) return std::nullopt;
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

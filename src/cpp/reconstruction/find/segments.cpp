#include "reconstruction/find/segments.hpp"

#include <algorithm>
#include <cmath>

#include "common/angles.hpp"
#include "common/units.hpp"
#include "detector/strip_plane.hpp"
#include "motion/helix.hpp"
#include "motion/views.hpp"
#include "reconstruction/find/compete.hpp"

namespace cgemit {

namespace {

constexpr double usual_z = 100;  // mm, of vertices of slow particles and of pairs
constexpr double slowed = 1.6;   // momentum at the origin over that in the segment
constexpr double slow_d = 15;    // mm, of slower particles from the beam line
// Of a circle and of its score, in combinations of two clusters.
constexpr std::int64_t work_of_circle = 10, work_of_score = 40;
constexpr int between_three = 2;  // layers between the outer ones of three

// Whether no track crosses both: parts that lie beside each other at about the same radius.
bool lie_beside(const MeasuringLayer& inner, const MeasuringLayer& outer) {
  const bool apart = inner.ends.high <= outer.ends.low || outer.ends.high <= inner.ends.low;
  return apart && outer.r_gap_in < inner.r_gap_out;
}

bool is_about_zero(const MeasuringLayer& layer) { return layer.ends.hold(0.0); }

// Whether a track through two layers crosses one between them: on a straight line, if one ends beside z = 0.
bool counts_between(const MeasuringLayer& inner, const MeasuringLayer& layer, const MeasuringLayer& outer) {
  if (is_about_zero(inner) && is_about_zero(layer) && is_about_zero(outer)) return true;
  const double share = (layer.r_mid() - inner.r_mid()) / (outer.r_mid() - inner.r_mid());
  return layer.ends.low <= std::lerp(inner.ends.low, outer.ends.low, share) &&
         std::lerp(inner.ends.high, outer.ends.high, share) <= layer.ends.high;
}

}  // namespace

std::vector<LayerPair> layer_pairs(const Detector& detector, int most_between) {
  const std::vector<MeasuringLayer>& layers = detector.layers;
  std::vector<LayerPair> pairs;
  for (std::size_t inner = 0; inner < layers.size(); ++inner)
    for (std::size_t outer = inner + 1; outer < layers.size(); ++outer) {
      if (lie_beside(layers[inner], layers[outer])) continue;
      int between = 0;
      for (std::size_t i = inner + 1; i < outer && between <= most_between; ++i)
        between += counts_between(layers[inner], layers[i], layers[outer]) ? 1 : 0;
      if (between <= most_between) pairs.push_back({inner, outer});
    }
  return pairs;
}

SegmentFinder::SegmentFinder(const Detector& detector, const FindSettings& settings)
    : detector_(detector),
      settings_(settings),
      twos_(layer_pairs(detector, between_two)),
      largest_w_(std::abs(curvature(detector.bz, 1 / settings.min_pt))),
      points_(detector.layers.size()),
      score_(detector, settings) {
  const std::vector<MeasuringLayer>& layers = detector.layers;
  for (const auto& [inner, outer] : layer_pairs(detector, between_three))
    for (std::size_t middle = inner + 1; middle < outer; ++middle)
      if (!lie_beside(layers[inner], layers[middle]) && !lie_beside(layers[middle], layers[outer]))
        threes_.push_back({inner, middle, outer});
}

void SegmentFinder::load(const EventHits& hits, bool all) {
  all_ = all;
  seeds_.clear();
  ranks_.clear();
  work_ = 0;
  dropped_ = false;
  made_.clear();
  range_.assign(static_cast<std::size_t>(hits.first_wire()), std::nullopt);
  for (std::size_t layer = 0; layer < points_.size(); ++layer) {
    points_[layer].clear();
    const MeasuringLayer& plane = detector_.layers[layer];
    for (std::int32_t id = hits.first(layer, View::x); id < hits.last(layer, View::x); ++id) {
      if (!all_ && hits.is_taken(id)) continue;
      const double phi = azimuth(plane, hits[id].channel, hits[id].value), r = plane.r_mid();
      points_[layer].push_back({r * std::cos(phi), r * std::sin(phi), phi, id});
    }
  }
}

// z of the crossings of an X cluster with the V clusters of its sheet.
auto SegmentFinder::heights(const EventHits& hits, std::size_t layer, const Point& point) -> Range {
  std::optional<Range>& range = range_[static_cast<std::size_t>(point.id)];
  if (range) return *range;
  const std::size_t first = made_.size();
  const MeasuringLayer& plane = detector_.layers[layer];
  work_ += hits.last(layer, View::v) - hits.first(layer, View::v);
  for (std::int32_t id = hits.first(layer, View::v); id < hits.last(layer, View::v); ++id) {
    if (hits[id].channel != hits[point.id].channel || (!all_ && hits.is_taken(id))) continue;
    const double z = crossing_z(plane, hits[point.id].value, hits[id].value);
    const double score = hits.pair_score(point.id, id);
    if (plane.ends.hold(z, 5) && score > PairScores::impossible) made_.push_back({z, score, id});
  }
  range = Range{first, made_.size()};
  return *range;
}

const std::vector<FindSeed>& SegmentFinder::three_layers(const EventHits& hits, bool all) {
  load(hits, all);
  score_.start(hits);
  for (const Layers& layers : threes_)
    if (!three_of(layers, hits)) break;
  return ranked();
}

// Whether there is work left for other layers.
bool SegmentFinder::three_of(const Layers& layers, const EventHits& hits) {
  const auto [inner, middle, outer] = layers;
  // No track turns by more between two layers, if it comes from near the beam line: the slowest one, or the
  // one that just reaches the outer layer.
  const double r_in = detector_.layers[inner].r_mid(), r_out = detector_.layers[outer].r_mid();
  const double w = std::min(largest_w_, 2 / r_out);
  const double bend = std::asin(0.5 * w * r_out) - std::asin(0.5 * w * r_in);
  const double window = bend + std::min(0.5, settings_.max_d * (1 / r_in - 1 / r_out));
  for (const Point& a : points_[inner]) {
    for (const Point& c : points_[outer]) {
      if (too_much()) return false;
      ++work_;
      const double turn = wrap_angle(c.phi - a.phi);
      if (std::abs(turn) > window) continue;
      work_ += static_cast<std::int64_t>(points_[middle].size());
      for (const Point& b : points_[middle]) {
        const double part = wrap_angle(b.phi - a.phi);
        if (std::abs(part - 0.5 * turn) > 0.5 * std::abs(turn) + 0.1) continue;
        three(layers, a, b, c, hits);
      }
    }
  }
  return true;
}

void SegmentFinder::three(const Layers& layers, const Point& a, const Point& b, const Point& c,
                          const EventHits& hits) {
  work_ += work_of_circle;
  if (!alone_ && !may_hold_line(layers, a, b, c, hits)) return;
  HelixPoint at = circle_through(a.x, a.y, b.x, b.y, c.x, c.y);
  if (std::abs(at.w) > slowed * largest_w_ || at.outward() < 0) return;
  const PivotApproach line = approach_pivot(at, 0, 0);
  const bool slow = std::abs(at.w) > 1.15 * largest_w_;
  if (!line.exists || std::abs(line.d) > (slow ? slow_d : settings_.max_d)) return;
  const Range low = heights(hits, layers[0], a), middle = heights(hits, layers[1], b),
              high = heights(hits, layers[2], c);
  heights_ = {of(low), of(middle), of(high)};
  if (std::ranges::count_if(heights_, [](const auto& one) { return !one.empty(); }) < (alone_ ? 2 : 3))
    return;
  work_ += work_of_score;
  const double s_a = -line.arc, s_b = s_a + arc_of(at.w, std::hypot(b.x - a.x, b.y - a.y)),
               s_c = s_a + arc_of(at.w, std::hypot(c.x - a.x, c.y - a.y));
  const Circle circle{{a.id, b.id, c.id},
                      {s_a, s_b, s_c},
                      line.d,
                      wrap_angle(std::atan2(at.uy, at.ux) + line.turn),
                      at.w / curvature(detector_.bz, 1.0),
                      slow ? usual_z : settings_.max_z};
  score_.circle(layers, circle.x, circle.s, circle.d, circle.kappa);
  lines_of_three(circle);
  if (!alone_) return;
  for (std::size_t first = 0; first < 2; ++first)
    for (std::size_t second = first + 1; second < 3; ++second) lines_of_two(circle, first, second);
}

// Whether three clusters may have heights on a line, by bounds without trigonometric functions. Most
// combinations of clusters with few heights fail. An arc of the chord c is longer by asin(u)/u, u = |w| c/2,
// a power series in u^2 of positive coefficients: at least 1 and at most 1 + (pi/2 - 1) u^2.
bool SegmentFinder::may_hold_line(const Layers& layers, const Point& a, const Point& b, const Point& c,
                                  const EventHits& hits) {
  constexpr double rounding = 1e-9;
  constexpr std::size_t few_lines = 4;
  const double abx = b.x - a.x, aby = b.y - a.y, acx = c.x - a.x, acy = c.y - a.y;
  const double ab2 = abx * abx + aby * aby, ac2 = acx * acx + acy * acy,
               bc2 = square(c.x - b.x) + square(c.y - b.y);
  const double w2 = 4 * square(abx * acy - aby * acx) / (ab2 * ac2 * bc2);
  if (w2 > (1 + rounding) * square(slowed * largest_w_)) return false;
  const Range low_range = heights(hits, layers[0], a), middle_range = heights(hits, layers[1], b),
              high_range = heights(hits, layers[2], c);
  heights_ = {of(low_range), of(middle_range), of(high_range)};
  const auto& [low_of, middle_of, high_of] = heights_;
  if (low_of.size() * middle_of.size() * high_of.size() > few_lines) return true;
  const auto longest = [&](double chord2) {
    return 1 + (0.5 * pi - 1) * std::min(0.25 * w2 * chord2, 1.0) + rounding;
  };
  const double ab = std::sqrt(ab2), ac = std::sqrt(ac2), arc_b = ab * longest(ab2), arc_c = ac * longest(ac2);
  const double least = ab / arc_c, most = ab <= ac ? ab / ac + rounding : arc_b / ac;
  const double kappa = (1 + rounding) * std::sqrt(w2) / std::abs(curvature(detector_.bz, 1.0));
  const double arc = std::max(arc_c - ab, arc_b - ac);
  for (const Height& low : low_of)
    for (const Height& high : high_of) {
      const double rise = high.z - low.z, tanl = (1 + rounding) * std::abs(rise) / ac;
      for (const Height& middle : middle_of) {
        const double one = middle.z - low.z - least * rise, other = middle.z - low.z - most * rise;
        const double off = one * other <= 0 ? 0 : std::min(std::abs(one), std::abs(other));
        if (!score_.is_hopeless(kappa, arc, tanl, off)) return true;
      }
    }
  return false;
}

void SegmentFinder::lines_of_three(const Circle& circle) {
  const auto& [low_of, middle_of, high_of] = heights_;
  const auto& [s_a, s_b, s_c] = circle.s;
  const auto& [a, b, c] = circle.x;
  for (const Height& low : low_of) {
    for (const Height& high : high_of) {
      if (too_much()) return;
      work_ += 1 + static_cast<std::int64_t>(middle_of.size());
      const double tanl = (high.z - low.z) / (s_c - s_a), z0 = low.z - tanl * s_a;
      if (std::abs(z0) > circle.most_z) continue;
      const double least = least_score() - score_.most_of_three(z0);
      const SegmentScore::Scatter scatter = score_.scatter(tanl);
      for (const Height& middle : middle_of) {
        const double pairs = low.score + middle.score + high.score;
        const double off = middle.z - low.z - tanl * (s_b - s_a);
        if (pairs < least || score_.is_far(scatter, off)) continue;
        const double score =
            pairs + score_.of_three(scatter, {low.id, middle.id, high.id}, off, z0, least_score() - pairs);
        if (score > least_score())
          add({circle.d, circle.psi, circle.kappa, z0, tanl}, settings_.max_d,
              {a, low.id, b, middle.id, c, high.id}, -score);
      }
    }
  }
}

// Lines through heights in two layers, without one in the third.
void SegmentFinder::lines_of_two(const Circle& circle, std::size_t first, std::size_t second) {
  for (const Height& low : heights_[first]) {
    if (too_much()) return;
    work_ += static_cast<std::int64_t>(heights_[second].size());
    for (const Height& high : heights_[second]) {
      const double tanl = (high.z - low.z) / (circle.s[second] - circle.s[first]),
                   z0 = low.z - tanl * circle.s[first];
      if (std::abs(z0) > circle.most_z) continue;
      const double pairs = low.score + high.score - doubt;
      if (pairs + score_.most_of_two(first, second, z0) < settings_.min_score) continue;
      const double score = pairs + score_.of_two(score_.scatter(tanl), first, second, z0);
      if (score <= settings_.min_score) continue;
      const auto& [a, b, c] = circle.x;
      std::vector<std::int32_t> hits{a, b, c};
      hits.insert(hits.begin() + static_cast<std::ptrdiff_t>(second) + 1, high.id);
      hits.insert(hits.begin() + static_cast<std::ptrdiff_t>(first) + 1, low.id);
      add({circle.d, circle.psi, circle.kappa, z0, tanl}, settings_.max_d, std::move(hits), -score);
    }
  }
}

const std::vector<FindSeed>& SegmentFinder::tracks(const EventHits& hits) {
  score_.start(hits);
  alone_ = true;
  three_layers(hits, true);
  alone_ = false;
  return seeds_;
}

const std::vector<FindSeed>& SegmentFinder::two_layers(const EventHits& hits) {
  load(hits, false);
  for (const auto& [inner, outer] : twos_)
    for (const Point& a : points_[inner])
      for (const Point& c : points_[outer]) {
        if (too_much()) return ranked();
        ++work_;
        two(inner, outer, a, c, hits);
      }
  return ranked();
}

void SegmentFinder::two(std::size_t inner, std::size_t outer, const Point& a, const Point& c,
                        const EventHits& hits) {
  if (a.x * c.x + a.y * c.y < 0) return;
  const HelixPoint at = circle_through(0, 0, a.x, a.y, c.x, c.y);
  if (std::abs(at.w) > 1.15 * largest_w_) return;
  const Range low_of = heights(hits, inner, a), high_of = heights(hits, outer, c);
  heights_ = {of(low_of), of(high_of), {}};
  const double s_a = arc_of(at.w, std::hypot(a.x, a.y)), s_c = arc_of(at.w, std::hypot(c.x, c.y));
  const double kappa = at.w / curvature(detector_.bz, 1.0);
  for (const Height& low : heights_[0]) {
    work_ += static_cast<std::int64_t>(heights_[1].size());
    for (const Height& high : heights_[1]) {
      const double tanl = (high.z - low.z) / (s_c - s_a), z0 = low.z - tanl * s_a;
      if (std::abs(z0) > usual_z) continue;
      const double far = z0 / (0.2 * usual_z);
      add({0, wrap_angle(std::atan2(at.uy, at.ux)), kappa, z0, tanl}, 1, {a.id, low.id, c.id, high.id},
          far * far - 2 * (low.score + high.score));
    }
  }
}

void SegmentFinder::add(const Perigee& helix, double sigma_d, std::vector<std::int32_t> hits, double rank) {
  const Five<double> variance{{sigma_d * sigma_d, 0.04, variance_of_kappa(helix.kappa), 2500, 0.25}};
  FindSeed seed{helix, Symmetric<double>::diagonal(variance), std::move(hits), rank};
  if (seed.helix.kappa == 0) seed.helix.kappa = 1e-9;
  ranks_.push_back({rank, seeds_.size()});
  seeds_.push_back(std::move(seed));
  if (seeds_.size() > 2 * most_kept() + 1000) keep_best();
}

// Leaves the best seeds, in their order; of equal ones the first found. A track of eight layers makes 18
// seeds: where there are too many, those go first of which better ones have every cluster.
void SegmentFinder::keep_best() {
  std::ranges::stable_sort(ranks_, [](const Ranked& a, const Ranked& b) { return a.rank < b.rank; });
  if (ranks_.size() > static_cast<std::size_t>(settings_.max_seeds)) {
    in_better_.assign(range_.size(), 0);
    std::erase_if(ranks_, [this](const Ranked& one) {
      bool any_new = false;
      for (const std::int32_t id : seeds_[one.seed].hits) {
        std::uint8_t& is_used = in_better_[static_cast<std::size_t>(id)];
        any_new = any_new || is_used == 0;
        is_used = 1;
      }
      return !any_new;
    });
  }
  dropped_ = dropped_ || ranks_.size() > most_kept();
  ranks_.resize(std::min(most_kept(), ranks_.size()));
  sorted_.clear();
  for (Ranked& one : ranks_) {
    sorted_.push_back(std::move(seeds_[one.seed]));
    one.seed = sorted_.size() - 1;
  }
  seeds_.swap(sorted_);
}

const std::vector<FindSeed>& SegmentFinder::ranked() {
  keep_best();
  return seeds_;
}

}  // namespace cgemit

#include "find/local.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <tuple>

#include "common/angles.hpp"
#include "detector/wires.hpp"
#include "motion/helix.hpp"

namespace cgemit {

namespace {

constexpr std::size_t ring_layers = 4;
constexpr double steepest = 2;         // tangent of the angle between a segment and the radius
constexpr double beside = 0.6;         // mm, of a hit between the ends of a segment, without curvature
constexpr double drift_error = 0.3;    // mm
constexpr double anywhere = 1000;      // mm, distance from the beam line that the fit of a circle expects
constexpr int more_layers = 1;         // than a circle from the beam line needs
constexpr double least_squares = 200;  // mm^2, lever of a hit that measures the curvature

std::uint64_t bit(const Detector& detector, std::size_t layer) {
  return std::uint64_t{1} << ((detector.cgem.size() + layer) % 64);
}

}  // namespace

LocalSearch::LocalSearch(const Detector& detector, AxialHits& axial) : detector_(detector), axial_(axial) {
  std::size_t run = 0;
  for (std::size_t i = 0; i < detector.wires.size(); ++i) {
    run = detector.wires[i].twist == 0 ? run + 1 : 0;
    if (run == ring_layers) {
      rings_.push_back(i + 1 - ring_layers);
      run = 0;
    }
  }
}

void LocalSearch::start(const EventHits& hits) {
  segments_.clear();
  curves_.clear();
  next_ = 0;
  for (const std::size_t ring : rings_) {
    pairs(ring, ring + 3, ring, hits);
    pairs(ring, ring + 2, ring, hits);
    pairs(ring + 1, ring + 3, ring, hits);
  }
  for (const Segment& segment : segments_) continued(segment);
  std::ranges::sort(curves_, [](const Curve& a, const Curve& b) {
    return std::tuple(-a.layers, a.psi, a.w, a.d) < std::tuple(-b.layers, b.psi, b.w, b.d);
  });
}

// Pairs of hits of two layers, not too far apart in azimuth.
void LocalSearch::pairs(std::size_t inner, std::size_t outer, std::size_t ring, const EventHits& hits) {
  const WireLayer &low = detector_.wires[inner], &high = detector_.wires[outer];
  const double reach = steepest * (high.r_end - low.r_end) / high.r_end * high.per_radian + 1;
  for (std::int64_t cell = 0; cell < low.cells; ++cell) {
    const std::int32_t a = hits.at(inner, cell);
    if (a < 0 || hits.is_taken(a)) continue;
    const Wire& from = low.placed[static_cast<std::size_t>(cell)];
    const double at = cell_coordinate(high, std::atan2(from.y, from.x), 0.0);
    for (double c = std::ceil(at - reach); c <= at + reach; c += 1) {
      const auto other = static_cast<std::int64_t>(c - high.cells * std::floor(c / high.cells));
      const std::int32_t b = hits.at(outer, other);
      if (b < 0 || hits.is_taken(b)) continue;
      tangents(from, std::max(hits[a].value, 0.0), high.placed[static_cast<std::size_t>(other)],
               std::max(hits[b].value, 0.0), inner, outer, ring, hits);
    }
  }
}

// The four lines that touch two drift circles, if a hit between them lies on the line.
void LocalSearch::tangents(const Wire& a, double drift_a, const Wire& b, double drift_b, std::size_t inner,
                           std::size_t outer, std::size_t ring, const EventHits& hits) {
  const double dx = b.x - a.x, dy = b.y - a.y, apart = std::hypot(dx, dy);
  for (const double one : {-drift_a, drift_a}) {
    for (const double other : {-drift_b, drift_b}) {
      if (segments_.size() >= most_segments) return;
      // The wires lie `one` and `other` to the left of the line.
      const double sine = (other - one) / apart;
      if (!(std::abs(sine) < 0.9)) continue;
      const double cosine = std::sqrt(1 - sine * sine);
      const double ux = (cosine * dx + sine * dy) / apart, uy = (cosine * dy - sine * dx) / apart;
      const double ax = a.x + one * uy, ay = a.y - one * ux, bx = b.x + other * uy, by = b.y - other * ux;
      Segment segment{0.5 * (ax + bx),
                      0.5 * (ay + by),
                      ux,
                      uy,
                      std::hypot(bx - ax, by - ay),
                      bit(detector_, inner) | bit(detector_, outer)};
      if (segment.x * ux + segment.y * uy <= 0) continue;
      for (std::size_t layer = inner + 1; layer < outer; ++layer)
        segment.layers |= supports(segment, layer, hits);
      const auto n = std::popcount(segment.layers);
      // All layers of the ring, or those three of it that no other pair of its layers has with the fourth.
      if (n >= (outer - inner == ring_layers - 1 ? 3 : 3)) segments_.push_back(segment);
    }
  }
  static_cast<void>(ring);
}

std::uint64_t LocalSearch::supports(const Segment& segment, std::size_t layer, const EventHits& hits) const {
  const WireLayer& wires = detector_.wires[layer];
  const double along_0 = segment.x * segment.ux + segment.y * segment.uy,
               across_0 = segment.x * segment.uy - segment.y * segment.ux;
  const double root = wires.r_end * wires.r_end - across_0 * across_0;
  if (!(root > 0)) return 0;
  const double step = std::sqrt(root) - along_0;
  const double px = segment.x + step * segment.ux, py = segment.y + step * segment.uy;
  const double at = cell_coordinate(wires, std::atan2(py, px), 0.0);
  const double bend =
      0.5 * axial_.largest_w() * std::max(0.25 * segment.chord * segment.chord - step * step, 0.0);
  for (double c = std::ceil(at - 1.5); c <= at + 1.5; c += 1) {
    const auto cell = static_cast<std::int64_t>(c - wires.cells * std::floor(c / wires.cells));
    const std::int32_t id = hits.at(layer, cell);
    if (id < 0 || hits.is_taken(id)) continue;
    const Wire& wire = wires.placed[static_cast<std::size_t>(cell)];
    const double left =
        (wire.y - segment.y) * segment.ux - (wire.x - segment.x) * segment.uy;
    if (std::abs(std::abs(left) - hits[id].value) < beside + bend) return bit(detector_, layer);
  }
  return 0;
}

// The curvature that most layers agree with.
void LocalSearch::continued(const Segment& segment) {
  const double largest = axial_.largest_w(), per_bin = bins / (2 * largest);
  const double quarter = 0.25 * segment.chord * segment.chord, turn = 2 * drift_error / segment.chord;
  const auto bin_of = [&](double w) {
    return static_cast<int>(std::floor(std::clamp((w + largest) * per_bin, -1.0, bins + 1.0)));
  };
  grid_.fill(segment.layers);
  const auto each = [&](auto&& act) {
    for (const AxialPoint& p : axial_.points()) {
      if (p.left_out || (p.layer & segment.layers) != 0) continue;
      const double x = p.x - segment.x, y = p.y - segment.y;
      const double along = x * segment.ux + y * segment.uy, left = y * segment.ux - x * segment.uy;
      const double squares = x * x + y * y - p.drift * p.drift - quarter;
      if (squares < least_squares) continue;
      const double error = 2 * (turn * std::abs(along) + drift_error) / squares;
      for (const double side : {-p.drift, p.drift}) act(p, 2 * (left + side) / squares, error);
    }
  };
  each([&](const AxialPoint& p, double w, double error) {
    const int last = std::min(bins - 1, bin_of(w + error));
    for (int i = std::max(0, bin_of(w - error)); i <= last; ++i) grid_[static_cast<std::size_t>(i)] |= p.layer;
  });
  int best = 0, count = 0;
  for (int i = 0; i < bins; ++i) {
    const int n = std::popcount(grid_[static_cast<std::size_t>(i)]);
    // Of equal ones the straightest.
    if (n > count || (n == count && std::abs(2 * i + 1 - bins) < std::abs(2 * best + 1 - bins))) {
      best = i;
      count = n;
    }
  }
  if (count < axial_.least() + more_layers) return;
  const double middle = (best + 0.5) / per_bin - largest;
  double sum = 0, weights = 0;
  each([&](const AxialPoint&, double w, double error) {
    if (std::abs(w - middle) > error + 0.5 / per_bin) return;
    const double weight = 1 / (error * error);
    sum += weight * w;
    weights += weight;
  });
  const double w = weights > 0 ? sum / weights : middle;
  // The circle passes beside the middle of its chord.
  const double sagitta = 0.5 * w * quarter;
  const HelixPoint at{segment.x + sagitta * segment.uy, segment.y - sagitta * segment.ux, 0, segment.ux,
                      segment.uy, 0, w};
  const PivotApproach line = approach_pivot(at, 0, 0);
  if (!line.exists) return;
  curves_.push_back({count, line.d, wrap_angle(std::atan2(at.uy, at.ux) + line.turn), w});
}

std::optional<FoundCircle> LocalSearch::next() {
  while (next_ < curves_.size()) {
    const Curve& curve = curves_[next_++];
    auto found = axial_.fit(curve.d, curve.psi, curve.w, anywhere, axial_.least() + more_layers);
    if (found) return found;
  }
  return std::nullopt;
}

}  // namespace cgemit

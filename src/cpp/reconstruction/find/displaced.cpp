#include "reconstruction/find/displaced.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <tuple>

#include "common/angles.hpp"
#include "detector/wires.hpp"
#include "motion/helix.hpp"

namespace cgemit {

namespace {

constexpr std::size_t many_segments = 200;
constexpr double steepest_segment = 2;   // tangent of the angle between a segment and the radius
constexpr double off_segment = 0.6;      // mm, of a hit between the ends of a segment, without curvature
constexpr double assumed_error = 0.3;    // mm
constexpr double any_distance = 1000;    // mm, distance from the beam line that the fit of a circle expects
constexpr int more_layers = 1;           // than a circle from the beam line needs
constexpr double least_lever = 200;      // mm^2, lever of a hit that measures the curvature
constexpr std::size_t most_between = 3;  // layers of other views between two of a ring
constexpr double on_circle = 2;          // mm, of a cluster from a circle through three others
constexpr std::size_t most_triples = 2'000'000;

std::int64_t number_of(const WireLayer& layer, double cell) {
  return static_cast<std::int64_t>(cell - layer.cells * std::floor(cell / layer.cells));
}

}  // namespace

DisplacedSearch::DisplacedSearch(const Detector& detector, AxialHits& axial)
    : detector_(detector),
      axial_(axial),
      single_(!axial.is_view() && std::ranges::any_of(detector.layers, [](const auto& layer) {
        return layer.has_x != layer.has_v;
      })) {
  const std::size_t apart = axial.is_view() ? most_between + 1 : 1;
  Ring ring{};
  std::size_t run = 0;
  for (std::size_t i = 0; i < detector.wires.size(); ++i) {
    if (!axial.has(detector.wires[i])) continue;
    if (run > 0 && i - ring[run - 1] > apart) run = 0;
    ring[run++] = i;
    if (run == ring_layers) {
      rings_.push_back(ring);
      run = 0;
    }
  }
}

// 1/mm, of tracks at a radius: in a view, of those that come from within `max_d` of the beam line.
double DisplacedSearch::most_curved(double r) const {
  const double largest = axial_.largest_w(), from = r - axial_.max_d();
  return axial_.is_view() && from > 0 ? std::min(largest, 2 / from) : largest;
}

void DisplacedSearch::start(const EventHits& hits) {
  segments_.clear();
  curves_.clear();
  next_ = 0;
  for (const Ring& ring : rings_) {
    pairs({ring, 0, 3}, hits);
    pairs({ring, 0, 2}, hits);
    pairs({ring, 1, 3}, hits);
  }
  // Where cells fire by chance, segments without a missing layer must do, the straightest ones.
  cut_ = segments_.size() >= most_segments;
  if (segments_.size() > many_segments) {
    std::erase_if(segments_, [](const Segment& s) { return std::popcount(s.layers) < int{ring_layers}; });
    std::ranges::stable_sort(segments_, [](const Segment& a, const Segment& b) { return a.off < b.off; });
    cut_ = cut_ || segments_.size() > many_segments;
    segments_.resize(std::min(segments_.size(), many_segments));
  }
  for (const Segment& segment : segments_) continued(segment);
  if (single_) through_clusters(hits);
  std::ranges::sort(curves_, [](const Curve& a, const Curve& b) {
    return std::tuple(-a.layers, a.far, a.psi, a.w, a.d) < std::tuple(-b.layers, b.far, b.psi, b.w, b.d);
  });
}

// Pairs of hits of two layers, not too far apart in azimuth.
void DisplacedSearch::pairs(const Ends& ends, const EventHits& hits) {
  const std::size_t inner = ends.ring[ends.inner], outer = ends.ring[ends.outer];
  const WireLayer &low = detector_.wires[inner], &high = detector_.wires[outer];
  const double reach = steepest_segment * (high.r_end - low.r_end) / high.r_end * high.per_radian + 1;
  for (std::int32_t a = hits.first_wire(inner); a < hits.last_wire(inner); ++a) {
    if (hits.is_taken(a)) continue;
    const Wire& from = low.placed[static_cast<std::size_t>(hits[a].channel)];
    const double at = cell_coordinate(high, std::atan2(from.y, from.x), 0.0);
    for (double c = std::ceil(at - reach); c <= at + reach; c += 1) {
      const std::int64_t other = number_of(high, c);
      const std::int32_t b = hits.at(outer, other);
      if (b < 0 || hits.is_taken(b)) continue;
      tangents(ends, {from.x, from.y, std::max(hits[a].value, 0.0)},
               {high.placed[static_cast<std::size_t>(other)].x,
                high.placed[static_cast<std::size_t>(other)].y, std::max(hits[b].value, 0.0)},
               hits);
    }
  }
}

// The four lines that touch two drift circles, where at most one layer of the ring has no hit on the line.
void DisplacedSearch::tangents(const Ends& ends, const Circle& a, const Circle& b, const EventHits& hits) {
  const double dx = b.x - a.x, dy = b.y - a.y, apart = std::hypot(dx, dy);
  for (const double one : {-a.drift, a.drift}) {
    for (const double other : {-b.drift, b.drift}) {
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
                      axial_.bit(ends.ring[ends.inner]) | axial_.bit(ends.ring[ends.outer]),
                      0};
      if (segment.x * ux + segment.y * uy <= 0) continue;
      for (std::size_t layer = ends.inner + 1; layer < ends.outer; ++layer)
        if (const auto off = closest(segment, ends.ring[layer], hits)) {
          segment.layers |= axial_.bit(ends.ring[layer]);
          segment.off += *off;
        }
      if (std::popcount(segment.layers) < int{ring_layers} - 1) continue;
      // Another pair of layers has it, with all four.
      if (ends.outer < ring_layers - 1 && closest(segment, ends.ring.back(), hits)) continue;
      if (ends.inner > 0 && closest(segment, ends.ring.front(), hits)) continue;
      segments_.push_back(segment);
    }
  }
}

// The distance of a hit of a layer from the segment, if curvature allows it.
std::optional<double> DisplacedSearch::closest(const Segment& segment, std::size_t layer,
                                               const EventHits& hits) const {
  const WireLayer& wires = detector_.wires[layer];
  const double along_0 = segment.x * segment.ux + segment.y * segment.uy,
               across_0 = segment.x * segment.uy - segment.y * segment.ux;
  const double root = wires.r_end * wires.r_end - across_0 * across_0;
  if (!(root > 0)) return std::nullopt;
  const double step = std::sqrt(root) - along_0;
  const double px = segment.x + step * segment.ux, py = segment.y + step * segment.uy;
  const double at = cell_coordinate(wires, std::atan2(py, px), 0.0);
  const double bend =
      0.5 * most_curved(wires.r_end) * std::abs(0.25 * segment.chord * segment.chord - step * step);
  std::optional<double> nearest;
  for (double c = std::ceil(at - 1.5); c <= at + 1.5; c += 1) {
    const std::int64_t cell = number_of(wires, c);
    const std::int32_t id = hits.at(layer, cell);
    if (id < 0 || hits.is_taken(id)) continue;
    const Wire& wire = wires.placed[static_cast<std::size_t>(cell)];
    const double left = (wire.y - segment.y) * segment.ux - (wire.x - segment.x) * segment.uy;
    const double off = std::abs(std::abs(left) - hits[id].value);
    if (off < off_segment + bend && !(nearest && *nearest <= off)) nearest = off;
  }
  return nearest;
}

// Counts the layers of other hits in each bin of the curvature at which the circle touches them.
void DisplacedSearch::count(const Segment& segment) {
  counts_.clear();
  const double largest = axial_.largest_w(), per_bin = bins / (2 * largest);
  const double quarter = 0.25 * segment.chord * segment.chord, turn = 2 * assumed_error / segment.chord;
  std::uint64_t layer = 0;
  BitCounts<words>::Bits in_layer{};
  ranges_.resize(2 * axial_.points().size());
  std::size_t used = 0;
  for (const AxialPoint& p : axial_.points()) {
    // Particles of half a turn do not come to the other side of the beam line.
    if ((p.layer & segment.layers) != 0 || p.x * segment.x + p.y * segment.y < 0) continue;
    const double x = p.x - segment.x, y = p.y - segment.y;
    const double along = x * segment.ux + y * segment.uy, left = y * segment.ux - x * segment.uy;
    const double squares = x * x + y * y - p.drift * p.drift - quarter;
    if (squares < least_lever) continue;
    if (p.layer != layer) {  // points of a layer follow each other
      counts_.add(in_layer);
      layer = p.layer;
      in_layer = {};
    }
    const double per = 2 / squares, error = per * (turn * std::abs(along) + assumed_error);
    for (const double side : {-p.drift, p.drift}) {
      const double w = per * (left + side);
      if (std::abs(w) > largest) continue;
      ranges_[used++] = {w, error};
      const int first = static_cast<int>(std::max((w - error + largest) * per_bin, 0.0)),
                last = static_cast<int>(std::min((w + error + largest) * per_bin, bins - 1.0));
      if (first <= last) set_bits(in_layer, static_cast<unsigned>(first), static_cast<unsigned>(last));
    }
  }
  counts_.add(in_layer);
  ranges_.resize(used);
}

// The bin closest to the middle, the lower one of two.
int DisplacedSearch::straightest(const BitCounts<words>::Bits& among) {
  int best = -1;
  for (int i = 0; i < bins; ++i) {
    const auto at = static_cast<unsigned>(i);
    if ((among[at / 64] >> at % 64 & 1) == 0) continue;
    if (best < 0 || std::abs(2 * i + 1 - bins) < std::abs(2 * best + 1 - bins)) best = i;
  }
  return best;
}

// The curvature that most layers agree with.
void DisplacedSearch::continued(const Segment& segment) {
  count(segment);
  const auto [others, where] = counts_.most();
  const int layers = std::popcount(segment.layers) + others, best = straightest(where);
  const double largest = axial_.largest_w(), per_bin = bins / (2 * largest);
  const double middle = (best + 0.5) / per_bin - largest;
  if (layers < axial_.least(middle) + more_layers) return;
  double sum = 0, weights = 0;
  const double half_bin = 0.5 / per_bin;
  for (const auto& [w, error] : ranges_) {
    if (std::abs(w - middle) > error + half_bin) continue;
    const double weight = 1 / (error * error);
    sum += weight * w;
    weights += weight;
  }
  const double w = weights > 0 ? sum / weights : middle;
  // The circle passes beside the middle of its chord.
  const double sagitta = 0.5 * w * (0.25 * segment.chord * segment.chord);
  const HelixPoint at{
      segment.x + sagitta * segment.uy, segment.y - sagitta * segment.ux, 0, segment.ux, segment.uy, 0, w};
  const PivotApproach line = approach_pivot(at, 0, 0);
  if (!line.exists) return;
  curves_.push_back({layers, 0, line.d, wrap_angle(std::atan2(at.uy, at.ux) + line.turn), w, more_layers});
}

// Circles through X clusters of three layers, with one layer of X between two of them at most.
void DisplacedSearch::through_clusters(const EventHits& hits) {
  std::vector<AxialPoint> points;
  for (const AxialPoint& p : axial_.points())
    if (!p.left_out && p.id < hits.first_wire()) points.push_back(p);
  std::vector<std::span<const AxialPoint>> layers;
  for (std::size_t i = 0, next = 0; i < points.size(); i = next) {
    while (next < points.size() && points[next].layer == points[i].layer) ++next;
    layers.push_back(std::span(points).subspan(i, next - i));
  }
  std::size_t work = 0;
  const auto circle = [&](const AxialPoint& a, const AxialPoint& b, const AxialPoint& c) {
    const HelixPoint at = circle_through(a.x, a.y, b.x, b.y, c.x, c.y);
    if (std::abs(at.w) > axial_.largest_w() || at.outward() < 0) return;
    const PivotApproach line = approach_pivot(at, 0, 0);
    if (!line.exists || std::abs(line.d) > axial_.max_d()) return;
    const double psi = wrap_angle(std::atan2(at.uy, at.ux) + line.turn);
    const int met = layers_on(line.d, psi, at.w, points);
    if (met >= axial_.least(at.w)) curves_.push_back({met, std::abs(line.d), line.d, psi, at.w, 0});
  };
  for (std::size_t i = 0; i + 2 < layers.size(); ++i)
    for (std::size_t j = i + 1; j < std::min(i + 3, layers.size()); ++j)
      for (std::size_t k = j + 1; k < std::min(j + 3, layers.size()); ++k)
        for (const AxialPoint& a : layers[i])
          for (const AxialPoint& c : layers[k]) {
            if (a.x * c.x + a.y * c.y < 0) continue;
            work += layers[j].size();
            if (work > most_triples) {
              cut_ = true;
              return;
            }
            for (const AxialPoint& b : layers[j])
              if (a.x * b.x + a.y * b.y > 0) circle(a, b, c);
          }
}

// Layers with a cluster on the circle.
int DisplacedSearch::layers_on(double d, double psi, double w, std::span<const AxialPoint> points) const {
  const double ux = std::cos(psi), uy = std::sin(psi);
  std::uint64_t layers = 0;
  for (const AxialPoint& p : points) {
    if (p.x * ux + p.y * uy < 0) continue;
    const double g =
        (1 - w * d) * (p.y * ux - p.x * uy) + d * (1 - 0.5 * w * d) - 0.5 * w * (p.x * p.x + p.y * p.y);
    if (std::abs(g) < on_circle) layers |= p.layer;
  }
  return std::popcount(layers);
}

std::optional<FoundCircle> DisplacedSearch::next() {
  while (next_ < curves_.size()) {
    const Curve& curve = curves_[next_++];
    auto found = axial_.fit({curve.d, curve.psi, curve.w, 0, 0, any_distance}, curve.more);
    if (found) return found;
  }
  return std::nullopt;
}

}  // namespace cgemit

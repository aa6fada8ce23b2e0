#include "reconstruction/find/stereo.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <bit>
#include <cmath>

#include "detector/strip_plane.hpp"
#include "motion/helix.hpp"

namespace cgemit {

namespace {

constexpr double largest_tanl = 3.2;
constexpr double wire_height_error = 4, strip_height_error = 2;  // mm, with the error of the circle
constexpr std::size_t most_heights = 400;
// Of the layers with heights, the best line has fewer by chance, and more if it is right.
constexpr double by_chance = 0.25, nearly_all = 0.8;
constexpr double most_layers = 0.7;              // of a line with another curvature
constexpr double slice = 10;                     // mm of z between curvatures, where it changes most
constexpr int most_slices = 8;                   // to either side
constexpr double widest = 2.5;                   // standard deviations of the curvature
constexpr double same_z = 10, same_tanl = 0.05;  // mm; lines that differ by less are one

// The bit closest to bit 32, the lower one of two.
int closest_to_middle(std::uint64_t bits) {
  constexpr int middle = 32;
  const std::uint64_t above = bits >> middle, below = bits << middle;
  const int up = std::countr_zero(above), down = std::countl_zero(below) + 1;
  if (above == 0) return middle - down;
  return below != 0 && down <= up ? middle - down : middle + up;
}

}  // namespace

StereoSearch::StereoSearch(const Detector& detector, const FindSettings& settings)
    : detector_(detector), settings_(settings) {}

// A wire lies to the left of the circle by a quadratic in z, and by plus or minus the drift distance where
// the track passes it.
void StereoSearch::wires(const FoundCircle& circle, const EventHits& hits) {
  const double ux = std::cos(circle.psi), uy = std::sin(circle.psi), n = 1 - circle.w * circle.d;
  const HelixPoint start{circle.d * uy, -circle.d * ux, 0, ux, uy, 0, circle.w};
  const CircleSlope slope(circle);
  for (std::int32_t id = hits.first_wire(); id < hits.size(); ++id) {
    const Hit& hit = hits[id];
    const auto index = static_cast<std::size_t>(hit.layer);
    const WireLayer& layer = detector_.wires[index];
    if (layer.twist == 0 || hits.is_taken(id)) continue;
    const Wire& wire = layer.placed[static_cast<std::size_t>(hit.channel)];
    if (wire.x * ux + wire.y * uy < 0) continue;
    const double gx = wire.ex / wire.ez, gy = wire.ey / wire.ez;
    const double g0 = n * (wire.y * ux - wire.x * uy) + circle.d * (1 - 0.5 * circle.w * circle.d) -
                      0.5 * circle.w * (wire.x * wire.x + wire.y * wire.y);
    const double g1 = (-n * uy - circle.w * wire.x) * gx + (n * ux - circle.w * wire.y) * gy;
    const double g2 = -0.5 * circle.w * (gx * gx + gy * gy);
    for (const double side : {-hit.value, hit.value}) {
      const double c = g0 - side, root = g1 * g1 - 4 * g2 * c;
      if (!(root >= 0)) continue;
      const double q = -0.5 * (g1 + std::copysign(std::sqrt(root), g1));
      if (q == 0) continue;
      const double z = c / q;  // the root that stays finite for a straight track
      if (layer.ends.miss(z)) continue;
      const PivotApproach at = approach_pivot(start, wire.x + gx * z, wire.y + gy * z);
      if (!at.exists || at.arc < 0) continue;
      const double x = wire.x + gx * z, y = wire.y + gy * z, along = x * ux + y * uy,
                   across = y * ux - x * uy;
      const double moved = (1 - circle.w * (across + circle.d)) * slope.d - n * along * slope.psi -
                           circle.d * across - 0.5 * circle.d * circle.d - 0.5 * (x * x + y * y);
      heights_.push_back(
          {at.arc, z, wire_height_error, std::uint64_t{1} << (index % 64), -moved / (g1 + 2 * g2 * z)});
    }
  }
}

void StereoSearch::strips(const FoundCircle& circle, const EventHits& hits) {
  const double ux = std::cos(circle.psi), uy = std::sin(circle.psi);
  const HelixPoint start{circle.d * uy, -circle.d * ux, 0, ux, uy, 0, circle.w};
  for (const std::int32_t x : circle.hits) {
    if (hits[x].view != View::x) continue;
    const auto layer = static_cast<std::size_t>(hits[x].layer);
    const MeasuringLayer& plane = detector_.layers[layer];
    HelixPoint at = start;
    double s = 0;
    if (!step_to_cylinder(at, plane.r_mid(), s)) continue;
    for (std::int32_t v = hits.first(layer, View::v); v < hits.last(layer, View::v); ++v) {
      if (hits[v].channel != hits[x].channel || !hits.may_pair(x, v)) continue;
      const double z = crossing_z(plane, hits[x].value, hits[v].value);
      if (plane.ends.miss(z, 5)) continue;
      heights_.push_back({s, z, strip_height_error, std::uint64_t{1} << (63 - layer % 32), 0});
    }
  }
}

// In layers that measure V alone, X is that of the circle.
void StereoSearch::strips_alone(const FoundCircle& circle, const EventHits& hits) {
  const double ux = std::cos(circle.psi), uy = std::sin(circle.psi);
  const HelixPoint start{circle.d * uy, -circle.d * ux, 0, ux, uy, 0, circle.w};
  for (std::size_t layer = 0; layer < detector_.layers.size(); ++layer) {
    const MeasuringLayer& plane = detector_.layers[layer];
    HelixPoint at = start;
    double s = 0;
    if (plane.has_x || !plane.has_v || !step_to_cylinder(at, plane.r_mid(), s)) continue;
    const double phi = std::atan2(at.y, at.x);
    for (std::int32_t v = hits.first(layer, View::v); v < hits.last(layer, View::v); ++v) {
      const double x = local_x(plane, hits[v].channel, phi);
      if (hits.is_taken(v) || x > plane.sheet_width()) continue;
      const double z = crossing_z(plane, x, hits[v].value);
      if (plane.ends.miss(z, 5)) continue;
      heights_.push_back({s, z, strip_height_error, std::uint64_t{1} << (63 - layer % 32), 0});
    }
  }
}

// Counts the layers in the bins of each slope. A height is read once, for the slopes that lead from it to a
// bin.
void StereoSearch::count(double dw) {
  constexpr double step = 2 * largest_tanl / slopes;
  const double per_bin = bins / (2 * settings_.max_z);
  counts_.clear();
  BitCounts<slopes>::Bits in_layer{};
  std::uint64_t layer = 0;
  for (const Height& height : heights_) {
    if (height.layer != layer) {  // heights of a layer follow each other
      counts_.add(in_layer);
      layer = height.layer;
      in_layer = {};
    }
    // The place in bins is from - slope * s at the middle of a slope.
    const double s = std::max(height.s * step * per_bin, 1e-9),
                 from = (height.z + dw * height.lever + settings_.max_z + largest_tanl * height.s) * per_bin -
                        0.5;
    const auto slope = [&](double place) {
      return std::clamp((from - place) / s - 0.5, 0.0, static_cast<double>(slopes));
    };
    const int last = static_cast<int>(std::ceil(slope(0)));
    for (int i = static_cast<int>(slope(bins - 1)); i < last; ++i) {
      const double place = from - (i + 0.5) * s;
      if (place >= 0 && place < bins - 1)
        in_layer[static_cast<std::size_t>(i)] |= std::uint64_t{3} << static_cast<int>(place);
    }
  }
  counts_.add(in_layer);
}

const std::vector<FoundLine>& StereoSearch::find(const FoundCircle& circle, const EventHits& hits,
                                                 std::size_t most, bool bend) {
  heights_.clear();
  lines_.clear();
  strips(circle, hits);
  strips_alone(circle, hits);
  wires(circle, hits);
  cut_ = cut_ || heights_.size() > most_heights;
  if (heights_.size() > most_heights) heights_.resize(most_heights);
  lines(most, 0, [this](double z0, double tanl) { return line(z0, tanl); });
  if (!bend || lines_.empty()) return lines_;
  std::uint64_t layers = 0;
  for (const Height& height : heights_) layers |= height.layer;
  const double share = lines_.front().layers / static_cast<double>(std::popcount(layers));
  if (share < by_chance || share >= nearly_all) return lines_;
  // No curvature makes a circle right that is none, as those of displaced tracks.
  const std::vector<FoundLine> straight = lines_;
  bent_lines(circle, most);
  if (lines_.empty() || lines_.front().layers < most_layers * std::popcount(layers)) lines_ = straight;
  return lines_;
}

// Lines for curvatures in steps that move heights by no more than a window of the fit.
void StereoSearch::bent_lines(const FoundCircle& circle, std::size_t most) {
  double lever = 0;
  for (const Height& height : heights_) lever = std::max(lever, std::abs(height.lever));
  const double sigma_w = std::sqrt(circle.covariance[5]), step = slice / std::max(lever, 1e-9);
  const int slices = std::min(most_slices, static_cast<int>(widest * sigma_w / step));
  if (slices == 0) return;
  scored_.clear();
  for (int i = -slices; i <= slices; ++i) {
    lines_.clear();
    const double dw = i * step;
    lines(most, dw, [&](double z0, double tanl) -> std::optional<FoundLine> {
      double score = 0;
      const auto found = bent({z0, tanl, {}, 0, dw}, sigma_w, score);
      if (found) scored_.push_back({*found, score});
      return found;
    });
  }
  std::ranges::stable_sort(scored_, [](const Scored& a, const Scored& b) { return a.score > b.score; });
  lines_.clear();
  for (const Scored& scored : scored_) {
    if (lines_.size() == most) return;
    const FoundLine& found = scored.line;
    const auto is_same = [&](const FoundLine& other) {
      return std::abs(found.z0 - other.z0) < same_z && std::abs(found.tanl - other.tanl) < same_tanl;
    };
    if (std::ranges::none_of(lines_, is_same)) lines_.push_back(found);
  }
}

template <class Fit>
void StereoSearch::lines(std::size_t most, double dw, const Fit& fit) {
  count(dw);
  const double step = 2 * largest_tanl / slopes, bin = 2 * settings_.max_z / bins;
  BitCounts<slopes>::Bits open;  // bins that no line was near
  open.fill(~std::uint64_t{0});
  for (std::size_t number = 0; number < most; ++number) {
    int best = 0, slope = 0,
        offset = 0;  // of the bins with most layers, the one whose z0 is closest to the origin
    for (int i = 0; i < slopes; ++i) {
      const auto [layers, where] =
          counts_.most(static_cast<std::size_t>(i), open[static_cast<std::size_t>(i)]);
      if (layers < best) continue;
      const int nearest = closest_to_middle(where);
      if (layers == best && std::abs(nearest - bins / 2) >= std::abs(offset - bins / 2)) continue;
      best = layers;
      slope = i;
      offset = nearest;
    }
    if (best < 2 || (!lines_.empty() && best < 0.7 * lines_.front().layers)) break;
    const auto found = fit(-settings_.max_z + (offset + 0.5) * bin, -largest_tanl + (slope + 0.5) * step);
    if (found) lines_.push_back(*found);
    constexpr int around = 5;  // bins
    const int low = std::max(0, offset - around), high = std::min(bins - 1, offset + around);
    for (int i = std::max(0, slope - around); i <= std::min(slopes - 1, slope + around); ++i)
      open[static_cast<std::size_t>(i)] &= ~((~std::uint64_t{0} >> (bins - 1 - high + low)) << low);
  }
}

// Least squares through the heights near a line, one window after the other.
std::optional<FoundLine> StereoSearch::line(double z0, double tanl) const {
  FoundLine found{z0, tanl, {}, 0};
  for (const double window : {25.0, 15.0, 10.0, 8.0}) {
    // Weak constraints keep the slope through close points finite.
    double n = 1 / (settings_.max_z * settings_.max_z), s1 = 0, s2 = 0.1, right_0 = -found.z0 * n,
           right_1 = -found.tanl * 0.1;
    std::uint64_t layers = 0;
    for (const Height& height : heights_) {
      const double off = height.z - found.z0 - found.tanl * height.s;
      if (std::abs(off) > window * std::sqrt(1 + 0.3 * found.tanl * found.tanl)) continue;
      const double weight = 1 / (height.error * height.error);
      n += weight;
      s1 += weight * height.s;
      s2 += weight * height.s * height.s;
      right_0 += weight * off;
      right_1 += weight * off * height.s;
      layers |= height.layer;
    }
    found.layers = std::popcount(layers);
    const double determinant = n * s2 - s1 * s1;
    if (found.layers < 2 || !(determinant > 0)) return std::nullopt;
    found.covariance = {s2 / determinant, -s1 / determinant, n / determinant};
    found.z0 += (s2 * right_0 - s1 * right_1) / determinant;
    found.tanl += (n * right_1 - s1 * right_0) / determinant;
  }
  return found;
}

// The same with the change of the curvature. The score: layers, less what the change and the fit cost.
std::optional<FoundLine> StereoSearch::bent(const FoundLine& first, double sigma_w, double& score) const {
  FoundLine found = first;
  for (const double window : {25.0, 15.0, 10.0, 8.0}) {
    Eigen::Matrix3d normal = Eigen::Vector3d(1 / (settings_.max_z * settings_.max_z), 0.1, 1).asDiagonal();
    // dw in units of its error
    Eigen::Vector3d right(-found.z0 * normal(0, 0), -found.tanl * 0.1, -found.dw / sigma_w);
    std::uint64_t layers = 0;
    double chi2 = 0;
    for (const Height& height : heights_) {
      const double off = height.z + found.dw * height.lever - found.z0 - found.tanl * height.s;
      if (std::abs(off) > window * std::sqrt(1 + 0.3 * found.tanl * found.tanl)) continue;
      const double weight = 1 / (height.error * height.error);
      const Eigen::Vector3d row(1, height.s, -sigma_w * height.lever);
      normal += weight * row * row.transpose();
      right += weight * off * row;
      chi2 += weight * off * off;
      layers |= height.layer;
    }
    found.layers = std::popcount(layers);
    if (found.layers < 2) return std::nullopt;
    score = found.layers - 0.5 * found.dw * found.dw / (sigma_w * sigma_w) - 0.1 * chi2;
    const Eigen::Matrix3d inverse = normal.inverse();
    const Eigen::Vector3d change = inverse * right;
    if (!change.allFinite()) return std::nullopt;
    found.covariance = {inverse(0, 0), inverse(0, 1), inverse(1, 1)};
    found.z0 += change[0];
    found.tanl += change[1];
    found.dw += change[2] * sigma_w;
  }
  return found;
}

}  // namespace cgemit

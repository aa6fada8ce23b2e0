#include "reconstruction/find/axial_hits.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <bit>
#include <cmath>

#include "common/angles.hpp"
#include "detector/strip_plane.hpp"
#include "motion/helix.hpp"

namespace cgemit {

namespace {

constexpr double hit_error = 0.3;    // mm, with the effects that a circle neglects
constexpr double last_window = 1.2;  // mm, of hits of a fitted circle
// Distance from a circle at which hits count, mm, and the share of the first errors that is left of them. Far
// outside or in a strong field these move the circle by more than the usual distance.
struct Window {
  double usual, share;
};
constexpr std::array<Window, 5> windows{{{4, 1}, {2.5, 0.25}, {1.6, 0}, {last_window, 0}, {last_window, 0}}};
constexpr double least_squares = 10;  // mm^2, r^2 - l^2 of a usable hit
constexpr double slow_pt = 0.06;      // GeV/c
constexpr int slow_layers = 4;
constexpr int fewest_layers = 3;  // which make a circle with the beam line
constexpr double per_occupancy_slow = 100;
constexpr double per_occupancy = 12;  // layers that a seed needs in addition, per share of fired cells
constexpr double beside_view = 1.5, more_d = 100;  // mm; a height turns into a distance from the beam line

// Drift distance with the side of the circle, minus the distance to the circle with the direction (ux, uy).
double residual(const FoundCircle& c, double ux, double uy, const AxialPoint& p) {
  const double g = (1 - c.w * c.d) * (p.y * ux - p.x * uy) + c.d * (1 - 0.5 * c.w * c.d) -
                   0.5 * c.w * (p.x * p.x + p.y * p.y);
  const double left = g / (1 - 0.5 * c.w * g);
  return std::copysign(p.drift, left) - left;
}

bool is_axial(const WireLayer& layer) { return layer.twist == 0; }

// How many axial layers of wires and layers with X one straight line from the origin crosses at most.
int crossed_together(const Detector& detector) {
  std::vector<Ends> slopes;
  const auto add = [&slopes](const Ends& ends, double r) { slopes.push_back({ends.low / r, ends.high / r}); };
  for (const MeasuringLayer& layer : detector.layers)
    if (layer.has_x) add(layer.ends, layer.r_mid());
  for (const WireLayer& layer : detector.wires)
    if (is_axial(layer)) add(layer.ends, layer.r_end);
  std::ptrdiff_t most = 0;
  for (const Ends& first : slopes)
    most = std::max(
        most, std::ranges::count_if(slopes, [&first](const Ends& one) { return bool(one.hold(first.low)); }));
  return static_cast<int>(most);
}

}  // namespace

int circle_layers(const Detector& detector, int least_axial) {
  if (std::ranges::all_of(detector.layers, [](const auto& one) { return one.has_x == one.has_v; }))
    return least_axial;
  // A track may leave through an end or turn back after three of them.
  const int few = std::ranges::any_of(detector.wires, is_axial)
                      ? std::max(crossed_together(detector) - 2, fewest_layers)
                      : fewest_layers;
  return std::min(least_axial, few);
}

int view_layers(int layers, int least_axial) {
  constexpr int missing = 2, share = 8;
  return std::max(std::min(least_axial, std::max(layers - missing, fewest_layers)), layers / share);
}

AxialHits::AxialHits(const Detector& detector, const FindSettings& settings, int sign)
    : detector_(detector),
      settings_(settings),
      sign_(sign),
      largest_w_(std::abs(curvature(detector.bz, 1 / settings.min_pt))),
      beside_(sign == 0 ? 0 : beside_view),
      max_d_(settings.max_d + (sign == 0 ? 0 : more_d)),
      bits_(detector.wires.size()),
      of_circle_(circle_layers(detector, settings.least_axial)),
      slow_w_(std::abs(curvature(detector.bz, 1 / slow_pt))) {
  std::size_t number = detector.layers.size();
  for (std::size_t i = 0; i < bits_.size(); ++i)
    if (has(detector.wires[i])) bits_[i] = std::uint64_t{1} << (number++ % 64);
}

void AxialHits::add(double x, double y, double drift, std::uint64_t layer, std::int32_t id) {
  const double squares = x * x + y * y - drift * drift;
  if (!(squares > least_squares)) return;
  points_.push_back({x, y, drift, 2 / squares, layer, id, false});
}

void AxialHits::load(const EventHits& hits) {
  points_.clear();
  double occupancy = 0;
  int layers = 0;
  for (std::size_t i = 0; i < detector_.wires.size(); ++i) {
    if (!has(detector_.wires[i])) continue;
    occupancy += hits.free_occupancy(i);
    ++layers;
  }
  const double share = layers > 0 ? occupancy / layers : 0;
  int across = 0;
  for (const MeasuringLayer& plane : detector_.layers) {
    if (is_view()) break;
    across += plane.has_x ? 1 : 0;
  }
  layers_ = layers + across;
  const int least = is_view() ? view_layers(layers, settings_.least_axial) : of_circle_;
  least_ = least + static_cast<int>(per_occupancy * share);
  too_many_ = least <= layers_ && layers_ < least_;
  least_slow_ = std::min(least_, slow_layers + static_cast<int>(per_occupancy_slow * share));
  for (std::int32_t id = 0; id < hits.size(); ++id) {
    if (hits.is_taken(id)) continue;
    const Hit& hit = hits[id];
    const auto layer = static_cast<std::size_t>(hit.layer);
    if (hit.view == View::x && !is_view()) {
      const MeasuringLayer& plane = detector_.layers[layer];
      const double phi = azimuth(plane, hit.channel, hit.value), r = plane.r_mid();
      add(r * std::cos(phi), r * std::sin(phi), 0, std::uint64_t{1} << (layer % 64), id);
    } else if (hit.view == View::wire && has(detector_.wires[layer])) {
      const Wire& wire = detector_.wires[layer].placed[static_cast<std::size_t>(hit.channel)];
      add(wire.x, wire.y, std::max(hit.value, 0.0), bits_[layer], id);
    }
  }
}

void AxialHits::leave_out(std::span<const std::int32_t> ids, bool left_out) {
  for (AxialPoint& p : points_)
    if (std::ranges::find(ids, p.id) != ids.end()) p.left_out = left_out;
}

std::optional<FoundCircle> AxialHits::fit(const CircleStart& start, int more) {
  FoundCircle c{start.d, start.psi, start.w, {}, {}};
  Eigen::Matrix3d normal;
  for (const auto& [usual, share] : windows) {
    const double half_psi = share * start.half_psi, half_w = share * start.half_w;
    normal.setZero();
    normal(0, 0) = 1 / (start.sigma_d * start.sigma_d);
    Eigen::Vector3d right(-c.d * normal(0, 0), 0, 0);
    const double ux = std::cos(c.psi), uy = std::sin(c.psi);
    c.hits.clear();
    std::uint64_t layers = 0;
    for (AxialPoint& p : points_) {
      const double along = p.x * ux + p.y * uy;
      if (p.left_out || along < 0) continue;
      const double off = residual(c, ux, uy, p);
      const double moved = half_psi * along + 0.5 * half_w * (p.x * p.x + p.y * p.y);
      if (std::abs(off) > std::max(usual, last_window + moved) + beside_) continue;
      const double across = p.y * ux - p.x * uy;
      const Eigen::Vector3d row(1 - c.w * (across + c.d), -(1 - c.w * c.d) * along,
                                -c.d * across - 0.5 * c.d * c.d - 0.5 * (p.x * p.x + p.y * p.y));
      constexpr double weight = 1 / (hit_error * hit_error);
      normal += weight * row * row.transpose();
      right += weight * off * row;
      c.hits.push_back(p.id);
      layers |= p.layer;
    }
    if (std::popcount(layers) < least(c.w) + more || c.hits.size() < static_cast<std::size_t>(least_))
      return std::nullopt;
    const Eigen::Vector3d step = normal.ldlt().solve(right);
    if (!step.allFinite()) return std::nullopt;
    c.d += step[0];
    c.psi = wrap_angle(c.psi + step[1]);
    c.w += step[2];
  }
  if (std::abs(c.d) > max_d_ || std::abs(c.w) > 1.15 * largest_w_) return std::nullopt;
  const Eigen::Matrix3d inverse = normal.inverse();
  c.covariance = {inverse(0, 0), inverse(0, 1), inverse(0, 2), inverse(1, 1), inverse(1, 2), inverse(2, 2)};
  const double ux = std::cos(c.psi), uy = std::sin(c.psi);
  for (AxialPoint& p : points_)
    if (!p.left_out && p.x * ux + p.y * uy > 0 && std::abs(residual(c, ux, uy, p)) < last_window + beside_)
      p.left_out = true;
  return c;
}

}  // namespace cgemit

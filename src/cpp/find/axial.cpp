#include "find/axial.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <functional>

#include "common/angles.hpp"
#include "detector/strip_plane.hpp"
#include "motion/helix.hpp"

namespace cgemit {

namespace {

constexpr double cell_psi = 2 * pi / 64;
constexpr int most_boxes = 4000;      // divided in one event
constexpr double hit_error = 0.3;     // mm, with the effects that a circle neglects
constexpr double beam_line = 5;       // mm, distance of tracks from the beam line that the fit expects
constexpr double least_squares = 10;  // mm^2, r^2 - l^2 of a usable hit
constexpr double per_occupancy = 12;  // layers that a seed needs in addition, per share of fired cells

}  // namespace

AxialSearch::AxialSearch(const Detector& detector, const FindSettings& settings)
    : detector_(detector),
      settings_(settings),
      largest_w_(std::abs(curvature(detector.bz, 1 / settings.min_pt))),
      grid_(static_cast<std::size_t>(columns * rows)),
      counts_(grid_.size()) {
  for (int i = 0; i < columns; ++i) columns_.emplace_back(-pi + i * cell_psi, cell_psi);
}

void AxialSearch::add(double x, double y, double drift, std::size_t layer, std::int32_t id) {
  const double squares = x * x + y * y - drift * drift;
  if (!(squares > least_squares)) return;
  points_.push_back({x, y, drift, 2 / squares, std::uint64_t{1} << (layer % 64), id, false});
}

void AxialSearch::load(const EventHits& hits) {
  points_.clear();
  const std::size_t gaps = detector_.cgem.size();
  double occupancy = 0;
  int layers = 0;
  for (std::size_t i = 0; i < detector_.wires.size(); ++i) {
    if (detector_.wires[i].twist != 0) continue;
    occupancy += hits.occupancy(i);
    ++layers;
  }
  least_ = settings_.least_axial + (layers > 0 ? static_cast<int>(per_occupancy * occupancy / layers) : 0);
  for (std::int32_t id = 0; id < hits.size(); ++id) {
    if (hits.is_taken(id)) continue;
    const Hit& hit = hits[id];
    const auto layer = static_cast<std::size_t>(hit.layer);
    if (hit.view == View::x) {
      const CgemLayer& cgem = detector_.cgem[layer];
      const double phi = azimuth(cgem, hit.channel, hit.value), r = cgem.r_mid();
      add(r * std::cos(phi), r * std::sin(phi), 0, layer, id);
    } else if (hit.view == View::wire && detector_.wires[layer].twist == 0) {
      const Wire& wire = detector_.wires[layer].placed[static_cast<std::size_t>(hit.channel)];
      add(wire.x, wire.y, std::max(hit.value, 0.0), gaps + layer, id);
    }
  }
  coarse();
}

int AxialSearch::deepest(double w) const {
  const double pt = std::abs(curvature(detector_.bz, 1.0)) / std::max(std::abs(w), 1e-9);
  return pt > 0.15 ? 5 : pt > 0.08 ? 4 : 3;  // slow tracks lose curvature on their way
}

// Whether one of the two curves of a hit crosses a box.
bool AxialSearch::touches(const Point& point, const Column& column, double w, double height) {
  if (!column.outward(point)) return false;
  const double one = column.at_low(point), other = column.at_high(point);
  const double low = std::min(one, other), high = std::max(one, other);
  for (const double side : {-point.drift, point.drift})
    if ((high + side) * point.per >= w && (low + side) * point.per <= w + height) return true;
  return false;
}

int AxialSearch::layers_in(const Box& box) const {
  std::uint64_t layers = 0;
  for (std::int32_t i = box.first; i < box.last; ++i) {
    const Point& p = points_[static_cast<std::size_t>(arena_[static_cast<std::size_t>(i)])];
    if (!p.left_out) layers |= p.layer;
  }
  return std::popcount(layers);
}

void AxialSearch::push(const Box& box) {
  if (box.layers < least_) return;
  heap_.push_back(box);
  std::ranges::push_heap(heap_, std::less<>());
}

// The boxes of the first grid with enough layers.
void AxialSearch::coarse() {
  heap_.clear();
  arena_.clear();
  divided_ = 0;
  std::uint64_t layers = 0;
  for (const Point& p : points_) layers |= p.layer;
  if (std::popcount(layers) < least_) return;
  std::ranges::fill(grid_, 0);
  std::ranges::fill(counts_, 0);
  const double height = 2 * largest_w_ / rows, per_height = 1 / height;
  const auto row_of = [&](double w) {
    return static_cast<int>(
        std::floor((std::clamp(w, -2 * largest_w_, 2 * largest_w_) + largest_w_) * per_height));
  };
  for (const Point& p : points_) {
    for (int column = 0; column < columns; ++column) {
      const Column& edges = columns_[static_cast<std::size_t>(column)];
      if (!edges.outward(p)) continue;
      const double one = edges.at_low(p), other = edges.at_high(p);
      for (const double side : {-p.drift, p.drift}) {
        const int first = std::max(0, row_of((std::min(one, other) + side) * p.per));
        const int last = std::min(rows - 1, row_of((std::max(one, other) + side) * p.per));
        for (int row = first; row <= last; ++row) {
          const auto at = static_cast<std::size_t>(column * rows + row);
          counts_[at] = static_cast<std::uint8_t>(counts_[at] + ((grid_[at] & p.layer) == 0 ? 1 : 0));
          grid_[at] |= p.layer;
        }
      }
    }
  }
  for (int column = 0; column < columns; ++column)
    for (int row = 0; row < rows; ++row)
      push({counts_[static_cast<std::size_t>(column * rows + row)], 0, -pi + column * cell_psi,
            -largest_w_ + row * height, -1, -1});
}

// The points of a box of the first grid.
void AxialSearch::collect(Box& box) {
  const Column column(box.psi, cell_psi);
  const double height = 2 * largest_w_ / rows;
  box.first = static_cast<std::int32_t>(arena_.size());
  for (std::size_t i = 0; i < points_.size(); ++i)
    if (!points_[i].left_out && touches(points_[i], column, box.w, height))
      arena_.push_back(static_cast<std::int32_t>(i));
  box.last = static_cast<std::int32_t>(arena_.size());
}

void AxialSearch::divide(const Box& box) {
  const int depth = box.depth + 1;
  const double width = cell_psi / (1 << depth), height = 2 * largest_w_ / rows / (1 << depth);
  for (int i = 0; i < 2; ++i) {
    const double psi = box.psi + i * width;
    const Column column(psi, width);
    for (int j = 0; j < 2; ++j) {
      Box child{0, depth, psi, box.w + j * height, static_cast<std::int32_t>(arena_.size()), 0};
      for (std::int32_t k = box.first; k < box.last; ++k) {
        const std::int32_t point = arena_[static_cast<std::size_t>(k)];
        if (touches(points_[static_cast<std::size_t>(point)], column, child.w, height))
          arena_.push_back(point);
      }
      child.last = static_cast<std::int32_t>(arena_.size());
      child.layers = layers_in(child);
      push(child);
    }
  }
}

// The count of a box is that of all its points when it was made; points left out since then lower it.
std::optional<FoundCircle> AxialSearch::next() {
  while (!heap_.empty() && divided_ < most_boxes) {
    std::ranges::pop_heap(heap_, std::less<>());
    Box box = heap_.back();
    heap_.pop_back();
    if (box.first < 0) collect(box);
    const int now = layers_in(box);
    if (now < box.layers) {
      box.layers = now;
      push(box);
    } else if (box.depth < deepest(box.w)) {
      ++divided_;
      divide(box);
    } else {
      const double scale = 1.0 / (1 << box.depth);
      auto found = circle(box.psi + 0.5 * cell_psi * scale, box.w + largest_w_ / rows * scale);
      // Whatever comes of it, the next search must find something else.
      for (std::int32_t i = box.first; i < box.last; ++i)
        points_[static_cast<std::size_t>(arena_[static_cast<std::size_t>(i)])].left_out = true;
      if (found) return found;
    }
  }
  return std::nullopt;
}

// Drift distance with the side of the circle, minus the distance to the circle.
double AxialSearch::residual(const FoundCircle& c, const Point& p) const {
  const double ux = std::cos(c.psi), uy = std::sin(c.psi);
  const double g = (1 - c.w * c.d) * (p.y * ux - p.x * uy) + c.d * (1 - 0.5 * c.w * c.d) -
                   0.5 * c.w * (p.x * p.x + p.y * p.y);
  const double left = g / (1 - 0.5 * c.w * g);
  return std::copysign(p.drift, left) - left;
}

// Fits a circle to the hits near one from the beam line.
std::optional<FoundCircle> AxialSearch::circle(double psi, double w) {
  FoundCircle c{0, psi, w, {}, {}};
  Eigen::Matrix3d normal;
  for (const double window : {4.0, 2.5, 1.6, 1.2, 1.2}) {
    normal.setZero();
    normal(0, 0) = 1 / (beam_line * beam_line);
    Eigen::Vector3d right(-c.d * normal(0, 0), 0, 0);
    const double ux = std::cos(c.psi), uy = std::sin(c.psi);
    c.hits.clear();
    std::uint64_t layers = 0;
    for (Point& p : points_) {
      if (p.left_out || p.x * ux + p.y * uy < 0) continue;
      const double off = residual(c, p);
      if (std::abs(off) > window) continue;
      const double across = p.y * ux - p.x * uy, along = p.x * ux + p.y * uy;
      const Eigen::Vector3d row(1 - c.w * (across + c.d), -(1 - c.w * c.d) * along,
                                -c.d * across - 0.5 * c.d * c.d - 0.5 * (p.x * p.x + p.y * p.y));
      constexpr double weight = 1 / (hit_error * hit_error);
      normal += weight * row * row.transpose();
      right += weight * off * row;
      c.hits.push_back(p.id);
      layers |= p.layer;
    }
    if (std::popcount(layers) < least_) return std::nullopt;
    const Eigen::Vector3d step = normal.ldlt().solve(right);
    if (!step.allFinite()) return std::nullopt;
    c.d += step[0];
    c.psi = wrap_angle(c.psi + step[1]);
    c.w += step[2];
  }
  if (std::abs(c.d) > settings_.max_d || std::abs(c.w) > 1.15 * largest_w_) return std::nullopt;
  const Eigen::Matrix3d inverse = normal.inverse();
  c.covariance = {inverse(0, 0), inverse(0, 1), inverse(0, 2), inverse(1, 1), inverse(1, 2), inverse(2, 2)};
  for (Point& p : points_)
    if (!p.left_out && std::abs(residual(c, p)) < 1.2 && p.x * std::cos(c.psi) + p.y * std::sin(c.psi) > 0)
      p.left_out = true;
  return c;
}

}  // namespace cgemit

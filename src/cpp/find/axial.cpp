#include "find/axial.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <functional>

#include "common/angles.hpp"
#include "motion/helix.hpp"

namespace cgemit {

namespace {

constexpr double cell_psi = 2 * pi / 64;
constexpr int most_boxes = 600;  // divided in one event
constexpr double beam_line = 5;  // mm, distance of tracks from the beam line that the fit expects

}  // namespace

AxialSearch::AxialSearch(const Detector& detector, AxialHits& hits)
    : detector_(detector),
      hits_(hits),
      points_(hits.points()),
      largest_w_(hits.largest_w()),
      grid_(static_cast<std::size_t>(columns * rows)),
      counts_(grid_.size()) {
  for (int i = 0; i < columns; ++i) columns_.emplace_back(-pi + i * cell_psi, cell_psi);
}

int AxialSearch::deepest(double w) const {
  const double pt = std::abs(curvature(detector_.bz, 1.0)) / std::max(std::abs(w), 1e-9);
  return pt > 0.15 ? 5 : pt > 0.08 ? 4 : 3;  // slow tracks lose curvature on their way
}

// Whether one of the two curves of a hit crosses a box.
bool AxialSearch::touches(const AxialPoint& point, const Column& column, double w, double height) {
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
    const AxialPoint& p = points_[static_cast<std::size_t>(arena_[static_cast<std::size_t>(i)])];
    if (!p.left_out) layers |= p.layer;
  }
  return std::popcount(layers);
}

void AxialSearch::push(const Box& box) {
  const double middle = box.w + largest_w_ / rows / (1 << box.depth);
  if (box.layers < hits_.least(middle)) return;
  heap_.push_back(box);
  std::ranges::push_heap(heap_, std::less<>());
}

// The boxes of the first grid with enough layers.
void AxialSearch::start() {
  heap_.clear();
  arena_.clear();
  divided_ = 0;
  std::uint64_t layers = 0;
  for (const AxialPoint& p : points_) layers |= p.layer;
  if (std::popcount(layers) < hits_.least(largest_w_)) return;
  std::ranges::fill(grid_, 0);
  std::ranges::fill(counts_, 0);
  const double height = 2 * largest_w_ / rows, per_height = 1 / height;
  const auto row_of = [&](double w) {
    return static_cast<int>(
        std::floor((std::clamp(w, -2 * largest_w_, 2 * largest_w_) + largest_w_) * per_height));
  };
  for (const AxialPoint& p : points_) {
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
      auto found =
          hits_.fit(0, box.psi + 0.5 * cell_psi * scale, box.w + largest_w_ / rows * scale, beam_line, 0);
      // Whatever comes of it, the next search must find something else.
      for (std::int32_t i = box.first; i < box.last; ++i)
        points_[static_cast<std::size_t>(arena_[static_cast<std::size_t>(i)])].left_out = true;
      if (found) return found;
    }
  }
  return std::nullopt;
}

}  // namespace cgemit

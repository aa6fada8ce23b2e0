#include "reconstruction/find/axial.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <functional>

#include "common/angles.hpp"
#include "motion/helix.hpp"
#include "reconstruction/find/bit_counts.hpp"

namespace cgemit {

namespace {

constexpr double cell_psi = 2 * pi / 64;
constexpr double beam_line = 5;  // mm, distance of tracks from the beam line that the fit expects

}  // namespace

AxialSearch::AxialSearch(const Detector& detector, AxialHits& hits)
    : detector_(detector),
      hits_(hits),
      points_(hits.points()),
      largest_w_(hits.largest_w()),
      counts_(static_cast<std::size_t>(columns * rows)) {
  for (int i = 0; i < columns; ++i) columns_.emplace_back(-pi + i * cell_psi, cell_psi);
}

int AxialSearch::deepest(double w) const {
  const double pt = std::abs(curvature(detector_.bz, 1.0)) / std::max(std::abs(w), 1e-9);
  return pt > 0.15 ? 5 : pt > 0.08 ? 4 : 3;  // slow tracks lose curvature on their way
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
  divided_ = circles_ = 0;
  std::uint64_t layers = 0;
  for (const AxialPoint& p : points_) layers |= p.layer;
  if (std::popcount(layers) < hits_.least(largest_w_)) return;
  crossed_.clear();
  for (int column = 0; column < columns; ++column) {
    fill(column);
    of_column_[static_cast<std::size_t>(column) + 1] = crossed_.size();
  }
  const double height = 2 * largest_w_ / rows;
  for (int column = 0; column < columns; ++column)
    for (int row = 0; row < rows; ++row) {
      const int at = column * rows + row;
      if (counts_[static_cast<std::size_t>(at)] < hits_.least(largest_w_)) continue;
      push({counts_[static_cast<std::size_t>(at)], 0, -pi + column * cell_psi, -largest_w_ + row * height, -1,
            at, 0});
    }
}

std::uint64_t AxialSearch::crossed_rows(const AxialPoint& point, const Column& edges) const {
  const Curves curves(point, edges);
  const double per_height = rows / (2 * largest_w_);
  std::uint64_t crossed = 0;
  for (std::size_t side = 0; side < 2; ++side) {
    const double low = (curves.low[side] + largest_w_) * per_height,
                 high = (curves.high[side] + largest_w_) * per_height;
    if (!(high >= 0 && low < rows)) continue;
    const int first = low > 0 ? static_cast<int>(low) : 0,
              last = high < rows ? static_cast<int>(high) : rows - 1;
    crossed |= (~std::uint64_t{0} >> (rows - 1 - last + first)) << first;
  }
  return crossed;
}

// Counts the layers in the boxes of a column that curves of their points cross.
void AxialSearch::fill(int column) {
  const Column& edges = columns_[static_cast<std::size_t>(column)];
  BitCounts<1> counts;
  std::uint64_t layer = 0, in_layer = 0;
  for (std::size_t i = 0; i < points_.size(); ++i) {
    const AxialPoint& point = points_[i];
    if (!edges.outward(point)) continue;
    const std::uint64_t crossed = crossed_rows(point, edges);
    if (crossed == 0) continue;
    crossed_.push_back({static_cast<std::int32_t>(i), crossed});
    if (point.layer != layer) {  // points of a layer follow each other
      counts.add({in_layer});
      layer = point.layer;
      in_layer = 0;
    }
    in_layer |= crossed;
  }
  counts.add({in_layer});
  for (int row = 0; row < rows; ++row)
    counts_[static_cast<std::size_t>(column * rows + row)] = counts.at(static_cast<std::size_t>(row));
}

// The points of a box of the first grid.
void AxialSearch::collect(Box& box) {
  const int row = box.last % rows;
  const auto column = static_cast<std::size_t>(box.last / rows);
  box.first = static_cast<std::int32_t>(arena_.size());
  for (std::size_t i = of_column_[column]; i < of_column_[column + 1]; ++i) {
    const Crossed& crossed = crossed_[i];
    if ((crossed.rows >> row & 1) != 0 && !points_[static_cast<std::size_t>(crossed.point)].left_out)
      arena_.push_back(crossed.point);
  }
  box.last = static_cast<std::int32_t>(arena_.size());
}

// The four boxes in the place of one. Its points are read once, and written without branches.
void AxialSearch::divide(const Box& box) {
  const int depth = box.depth + 1;
  const double width = cell_psi / (1 << depth), height = 2 * largest_w_ / rows / (1 << depth);
  const double middle = box.w + height;
  const std::array<double, 2> psi{box.psi, box.psi + width}, bottom{box.w, middle},
      top{middle, middle + height};
  const Column left(psi[0], width), right(left, psi[1] + width);
  const auto begin = arena_.size(), most = static_cast<std::size_t>(box.last - box.first);
  arena_.resize(begin + 4 * most);
  std::array<std::size_t, 4> end{begin, begin + most, begin + 2 * most, begin + 3 * most};
  std::array<std::uint64_t, 4> layers{};
  for (std::int32_t k = box.first; k < box.last; ++k) {
    const std::int32_t number = arena_[static_cast<std::size_t>(k)];
    const AxialPoint& point = points_[static_cast<std::size_t>(number)];
    if (point.left_out) continue;
    const auto enter = [&](std::size_t which, bool inside) {
      arena_[end[which]] = number;
      end[which] += inside ? 1 : 0;
      layers[which] |= inside ? point.layer : 0;
    };
    const auto both = [&](std::size_t column, const Column& edges) {
      const bool outward = edges.outward(point);
      const Curves curves(point, edges);
      for (std::size_t half = 0; half < 2; ++half)
        enter(2 * column + half, outward & curves.cross(bottom[half], top[half]));
    };
    both(0, left);
    both(1, right);
  }
  for (std::size_t i = 0; i < 4; ++i)
    push({std::popcount(layers[i]), depth, psi[i / 2], bottom[i % 2],
          static_cast<std::int32_t>(begin + i * most), static_cast<std::int32_t>(end[i]), circles_});
}

// The count of a box is that of all its points when it was made; points left out since then lower it.
std::optional<FoundCircle> AxialSearch::next() {
  while (!heap_.empty() && divided_ < most_boxes) {
    std::ranges::pop_heap(heap_, std::less<>());
    Box box = heap_.back();
    heap_.pop_back();
    if (box.first < 0) collect(box);
    const int now = box.counted == circles_ ? box.layers : layers_in(box);
    box.counted = circles_;
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
      ++circles_;
      for (std::int32_t i = box.first; i < box.last; ++i)
        points_[static_cast<std::size_t>(arena_[static_cast<std::size_t>(i)])].left_out = true;
      if (found) return found;
    }
  }
  return std::nullopt;
}

}  // namespace cgemit

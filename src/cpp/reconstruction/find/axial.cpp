#include "reconstruction/find/axial.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <functional>

#include "common/angles.hpp"
#include "motion/helix.hpp"
#include "reconstruction/find/bit_counts.hpp"

namespace cgemit {

namespace {

constexpr int coarse = 64;  // columns and rows of the plane, from which depths are counted
constexpr double cell_psi = 2 * pi / coarse;
constexpr double beam_line = 5;  // mm, distance of tracks from the beam line that the fit expects
// Where there are so many points, nearly all boxes of a coarse grid have points in all layers.
constexpr std::size_t many_points = 300;
constexpr int finest = 3;          // depth of a first grid
constexpr double rounding = 1e-3;  // of the height of a box, more than that of `float`
constexpr double fresh = 0.7;      // a finer grid is made anew when fewer of its points are left

// The first of half as many columns as there are that have a point on the half turn that leaves the beam
// line.
int first_column(const AxialPoint& point, int size) {
  const double phi = std::atan2(point.y, point.x);
  return static_cast<int>(std::ceil((phi + 2.5 * pi) * size / (2 * pi) - 0.5)) % size;
}

}  // namespace

AxialSearch::AxialSearch(const Detector& detector, AxialHits& hits)
    : detector_(detector), hits_(hits), points_(hits.points()), largest_w_(hits.largest_w()) {
  for (const WireLayer& layer : detector.wires) radius_ = std::max(radius_, std::sqrt(layer.waist));
}

int AxialSearch::deepest(double w) const {
  if (hits_.is_view()) {        // until boxes are small where the circle leaves the wires
    constexpr double size = 4;  // mm
    constexpr int least_depth = 3, most_depth = 10;
    const double r = std::min(radius_, 2 / std::max(std::abs(w), 1e-9));
    const double width = std::max(cell_psi * r, largest_w_ / coarse * r * r);
    return std::clamp(static_cast<int>(std::ceil(std::log2(width / size))), least_depth, most_depth);
  }
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
  if (!is_worth(box)) return;
  heap_.push_back(box);
  std::ranges::push_heap(heap_, std::less<>());
}

bool AxialSearch::is_worth(const Box& box) const {
  return box.layers >= hits_.least(box.w + largest_w_ / coarse / (1 << box.depth));
}

void AxialSearch::start() {
  circles_ = 0;
  make_grid();
}

// Whether many points of the first grid led to circles.
bool AxialSearch::is_stale() const {
  const auto left = static_cast<double>(std::ranges::count(points_, false, &AxialPoint::left_out));
  return left < fresh * static_cast<double>(points_.size());
}

// The boxes of the first grid with enough layers.
void AxialSearch::make_grid() {
  heap_.clear();
  arena_.clear();
  divided_ = 0;
  std::erase_if(points_, [](const AxialPoint& p) { return p.left_out; });
  std::uint64_t layers = 0;
  for (const AxialPoint& p : points_) layers |= p.layer;
  first_depth_ = 0;
  if (std::popcount(layers) < hits_.least(largest_w_)) return;
  while (first_depth_ < finest && points_.size() > many_points << first_depth_) ++first_depth_;
  switch (first_depth_) {
    case 0:
      fill<1>();
      break;
    case 1:
      fill<2>();
      break;
    case 2:
      fill<4>();
      break;
    default:
      fill<8>();
  }
  std::ranges::make_heap(heap_, std::less<>());
  const double width = cell_psi / (1 << first_depth_), height = 2 * largest_w_ / coarse / (1 << first_depth_);
  bands_.clear();
  for (const AxialPoint& p : points_) {
    const double reach = p.per * (p.drift + 0.5 * width * std::hypot(p.x, p.y)) + (0.5 + rounding) * height;
    bands_.x.push_back(static_cast<float>(p.x * p.per));
    bands_.y.push_back(static_cast<float>(p.y * p.per));
    bands_.reach.push_back(static_cast<float>(reach));
  }
}

// Sets the bits of the rows that the two curves of a point cross in some columns of a block. The rows of all
// columns are computed in a loop without branches.
template <std::size_t words>
void AxialSearch::cross(const AxialPoint& point, const Edges& edges, std::size_t from, std::size_t to,
                        std::array<std::uint64_t, block * words>& crossed) const {
  constexpr int rows = 64 * words;
  const double per_row = rows / (2 * largest_w_) * point.per;
  const auto shift = static_cast<float>(point.drift * per_row), x = static_cast<float>(point.x * per_row),
             y = static_cast<float>(point.y * per_row);
  std::array<float, block + 1> across;
  for (std::size_t i = 0; i <= block; ++i) across[i] = y * edges.cosine[i] - x * edges.sine[i] + rows / 2;
  std::array<std::array<std::int32_t, block>, 2> first, end;
  for (std::size_t i = 0; i < block; ++i) {
    const float low = std::min(across[i], across[i + 1]), high = std::max(across[i], across[i + 1]) + 1;
    const auto bit = [i](float row) {
      return static_cast<std::int32_t>(i) * rows +
             static_cast<std::int32_t>(std::min(std::max(row, 0.0F), float{rows}));
    };
    first[0][i] = bit(low - shift);
    end[0][i] = bit(high - shift);
    first[1][i] = bit(low + shift);
    end[1][i] = bit(high + shift);
  }
  for (std::size_t i = from; i < to; ++i)
    for (std::size_t side = 0; side < 2; ++side)
      if (first[side][i] < end[side][i])
        set_bits(crossed, static_cast<unsigned>(first[side][i]), static_cast<unsigned>(end[side][i] - 1));
}

// Counts the layers in the boxes that curves of their points cross, a block of columns at a time.
template <std::size_t words>
void AxialSearch::fill() {
  constexpr int size = 64 * words, columns = block;
  constexpr double width = 2 * pi / size;
  const double height = 2 * largest_w_ / size;
  const auto least = static_cast<unsigned>(hits_.least(largest_w_));
  begins_.clear();
  for (const AxialPoint& point : points_) begins_.push_back(first_column(point, size));
  for (int begin = 0; begin < size; begin += columns) {
    Edges edges;
    for (int i = 0; i <= columns; ++i) {
      const double psi = -pi + (begin + i) * width;
      edges.cosine[static_cast<std::size_t>(i)] = static_cast<float>(std::cos(psi));
      edges.sine[static_cast<std::size_t>(i)] = static_cast<float>(std::sin(psi));
    }
    BitCounts<block * words> counts;  // of one column after the other
    typename BitCounts<block * words>::Bits in_layer{};
    std::uint64_t layer = 0;
    for (std::size_t number = 0; number < points_.size(); ++number) {
      const AxialPoint& point = points_[number];
      // Of the half turn of size/2 columns the block has the first ones, the last ones, all or none.
      const int offset = (begins_[number] - begin + size) % size;
      const int from = offset < columns ? offset : 0,
                to = offset < columns ? columns : std::min(offset - size / 2, columns);
      if (from >= to) continue;
      if (point.layer != layer) {  // points of a layer follow each other
        counts.add(in_layer);
        layer = point.layer;
        in_layer = {};
      }
      cross<words>(point, edges, static_cast<std::size_t>(from), static_cast<std::size_t>(to), in_layer);
    }
    counts.add(in_layer);
    const auto enough = counts.at_least(least);
    for (std::size_t word = 0; word < enough.size(); ++word)
      for (std::uint64_t bits = enough[word]; bits != 0; bits &= bits - 1) {
        const std::size_t at = 64 * word + static_cast<std::size_t>(std::countr_zero(bits));
        const Box box{counts.at(at),
                      first_depth_,
                      -pi + (begin + static_cast<int>(at / size)) * width,
                      -largest_w_ + static_cast<double>(at % size) * height,
                      -1,
                      -1,
                      circles_};
        if (is_worth(box)) heap_.push_back(box);
      }
  }
}

// The points of a box of the first grid. Nearly all of them fail the first test, which costs least.
void AxialSearch::collect(Box& box) {
  const double scale = 1.0 / (1 << box.depth), width = cell_psi * scale,
               height = 2 * largest_w_ / coarse * scale;
  const Column edges(box.psi, width);
  const double middle = box.psi + 0.5 * width;
  box.first = static_cast<std::int32_t>(arena_.size());
  const auto x = static_cast<float>(std::sin(middle)), y = static_cast<float>(std::cos(middle)),
             w = static_cast<float>(box.w + 0.5 * height);
  near_.resize(points_.size());
  for (std::size_t i = 0; i < near_.size(); ++i)
    near_[i] = std::abs(bands_.y[i] * y - bands_.x[i] * x - w) <= bands_.reach[i] ? 1 : 0;
  const std::uint8_t *const begin = near_.data(), *const end = begin + near_.size(), *at = begin;
  while (at < end && (at = static_cast<const std::uint8_t*>(
                          std::memchr(at, 1, static_cast<std::size_t>(end - at)))) != nullptr) {
    const auto i = at++ - begin;
    const AxialPoint& point = points_[static_cast<std::size_t>(i)];
    if (!point.left_out && edges.outward(point) && Curves(point, edges).cross(box.w, box.w + height))
      arena_.push_back(static_cast<std::int32_t>(i));
  }
  box.last = static_cast<std::int32_t>(arena_.size());
}

// The four boxes in the place of one. Its points are read once, and written without branches.
void AxialSearch::divide(const Box& box) {
  const int depth = box.depth + 1;
  const double width = cell_psi / (1 << depth), height = 2 * largest_w_ / coarse / (1 << depth);
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
  if (first_depth_ > 0 && is_stale()) make_grid();
  while (!heap_.empty() && divided_ < limit()) {
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
      const double half_psi = 0.5 * cell_psi * scale, half_w = largest_w_ / coarse * scale;
      auto found = hits_.fit({0, box.psi + half_psi, box.w + half_w, half_psi, half_w, beam_line}, 0);
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

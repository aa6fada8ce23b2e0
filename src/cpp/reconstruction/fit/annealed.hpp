// Robust curve fit to drift circles: distance known, side unknown, some outliers. The points of one track lie
// side by side in the lanes.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>
#include <type_traits>

#include "common/compiler.hpp"
#include "common/lanes/number.hpp"

namespace cgemit {

// The constraint of one point: the curve passes at `drift` from it, and the point lies to its left (side 1),
// right (-1) or either (0).
template <class T>
struct DriftCircle {
  T drift, side;
  T per_error;  // 1/mm, one over the smallest expected error
  T votes;      // its weight when curves are compared

  // Distance of the curve from the circle, mm; the point is `left` mm to the left of the curve.
  T miss(const T& left) const { return select(side == 0.0, abs(left) - drift, left - side * drift); }
  // Its votes, in proportion to the part of its distance from the curve beyond `errors` errors.
  T lost(const T& left, double errors) const {
    const T far = miss(left) * per_error / errors, square = far * far;
    return votes * square / (1.0 + square);
  }
};

// The offset to the left of the curve at which the curve should pass, and the weight of this offset.
template <class T>
struct Attraction {
  T offset, weight;
};

// For an unknown side the two possibilities are averaged at the present scale (in errors). Points far outside
// have almost no weight (Geman and McClure, Bull. Int. Stat. Inst. 52 (1987) 5).
template <class T>
Attraction<T> attraction_of(const DriftCircle<T>& of, const T& left, double scale) {
  const T per_spread = of.per_error / scale, per_variance = per_spread * per_spread;
  const T far = of.miss(left) * per_spread, discount = 1.0 + far * far / 9.0;
  return {choose(
              of.side != 0.0, [&] { return of.side * of.drift; },
              [&] {
                const T certain = of.drift * left * per_variance;
                return of.drift * certain / sqrt(1.0 + certain * certain);
              }),
          choose(
              of.side != 0.0, [&] { return per_variance / (discount * discount); },
              [&] {
                const T certain = of.drift * left * per_variance, square = 1.0 + certain * certain;
                return per_variance * square /
                       ((square + of.drift * of.drift * per_variance) * discount * discount);
              })};
}

// `Shape` has a Model (the curve), a Point with its DriftCircle, whose members are all numbers T, the
// distance `left` of a point from a model, the number of points that determine a model (`least`), and Sums,
// which take points with their attractions, add up the lanes and solve for the model.
template <class Shape>
class Annealed {
 public:
  using Model = typename Shape::Model;
  using Point = typename Shape::template Point<double>;
  using Points = typename Shape::template Point<Number>;

  struct Result {
    std::optional<Model> model;
    double scale;  // in errors, the distance of most points from the curve; at least 1
  };

  // Points beyond the capacity are ignored: they would not improve a first helix.
  void add(const Point& point) {
    if (n_ < most) put(n_++, point);
  }
  // The points of a mask.
  void add(const Points& points, const mask_of<Number>& those) {
    if (n_ % width == 0 && n_ < most && all(those)) {
      points_[n_ / width] = points;
      n_ += width;
    } else {
      each_lane(those, [&](int i) { add(of_lane(points, i)); });
    }
  }

  // The curve near a first one that is off by up to half a cell: sides begin undecided. Without RANSAC.
  Result near(Model model) {
    if (n_ < Shape::least) return {std::nullopt, 0};
    fill_up();
    constexpr double last = 1.5, cooling = 5;
    for (double scale = largest_drift();; scale = std::max(scale / cooling, last)) {
      find_left(model);
      const auto next = moved(model, scale);
      if (!next) return {std::nullopt, 0};
      model = *next;
      if (scale <= last) break;
    }
    return {model, measure(model, first)};
  }

  // Least squares with weights that become sharper as the curve improves. If many points are still lost,
  // RANSAC is tried as well.
  Result result() {
    if (n_ < Shape::least) return {std::nullopt, 0};
    fill_up();
    Sums sums;
    for (std::size_t i = 0; i < packs_; ++i) {
      const Points& points = points_[i];
      const Number square = points.drift_circle.per_error * points.drift_circle.per_error,
                   drift = points.drift_circle.drift;
      sums.add(points, nullptr, {0.0, square / (square * drift * drift + first * first)});
    }
    const Result plain = settled(sums.solve());
    const double plain_lost = lost();
    if (!plain.model || plain.scale < 2 || n_ <= Shape::least + 1 || plain_lost < few * votes()) return plain;
    const Result other = settled(ransac());
    return other.model && lost() < 0.9 * plain_lost ? other : plain;
  }

 private:
  using Sums = typename Shape::template Sums<Number>;
  static constexpr double first = 20, close = 5;     // errors
  static constexpr double few = 0.05, enough = 0.2;  // of the votes
  static constexpr std::size_t trials = 12;
  static constexpr int passes = 6;
  static constexpr std::size_t most = 128, width = lanes_of<Number>;
  static constexpr std::size_t members = sizeof(Point) / sizeof(double);

  // A point, or the points of the lanes, as an array of its members.
  template <class P>
  static auto* members_of(P& point) {
    using Member = std::conditional_t<sizeof(P) == sizeof(Point), double, Number>;
    return reinterpret_cast<std::conditional_t<std::is_const_v<P>, const Member, Member>*>(&point);
  }
  void put(std::size_t i, const Point& point) {
    for (std::size_t m = 0; m < members; ++m)
      set_lane(members_of(points_[i / width])[m], static_cast<int>(i % width), members_of(point)[m]);
  }
  static Point of_lane(const Points& points, int i) {
    Point point;
    for (std::size_t m = 0; m < members; ++m) members_of(point)[m] = lane(members_of(points)[m], i);
    return point;
  }
  Point point(std::size_t i) const { return of_lane(points_[i / width], static_cast<int>(i % width)); }

  // Repeats the last point without weight in the free lanes.
  void fill_up() {
    packs_ = (n_ + width - 1) / width;
    Point idle = point(n_ - 1);
    idle.drift_circle.per_error = idle.drift_circle.votes = 0;
    for (std::size_t i = n_; i < packs_ * width; ++i) put(i, idle);
  }

  Result settled(std::optional<Model> model) {
    if (!model) return {std::nullopt, 0};
    double scale = measure(*model, first);
    for (int pass = 0; pass < passes; ++pass) {
      const auto next = moved(*model, scale);
      if (!next) break;
      model = next;
      const double now = measure(*model, scale);
      const bool sharp = scale < 2, stuck = now > 0.7 * scale && pass > 1;
      scale = now;
      if (sharp || stuck) break;
    }
    return {model, scale};
  }

  // Measures the distances of the points from the curve. Returns the distance of most points; points far
  // outside the last scale count as if they were at its edge.
  CGEMIT_FLATTEN double measure(const Model& model, double scale) {
    Number far(0.0);
    for (std::size_t i = 0; i < packs_; ++i) {
      const Points& points = points_[i];
      left_[i] = Shape::left(model, points);
      const DriftCircle<Number>& of = points.drift_circle;
      far += smaller(abs(of.miss(left_[i])) * of.per_error, 1.5 * scale);
    }
    return std::max(1.2 * sum(far) / static_cast<double>(n_), 1.0);
  }

  void find_left(const Model& model) {
    for (std::size_t i = 0; i < packs_; ++i) left_[i] = Shape::left(model, points_[i]);
  }

  // In errors, at least 1.
  double largest_drift() const {
    Number drift(0.0);
    for (std::size_t i = 0; i < packs_; ++i) {
      const DriftCircle<Number>& of = points_[i].drift_circle;
      drift = larger(drift, of.drift * of.per_error);
    }
    double found = 1;
    for (int i = 0; i < lanes_of<Number>; ++i) found = std::max(found, lane(drift, i));
    return found;
  }

  // Votes of the points that the last measured curve misses.
  double lost() const {
    Number votes(0.0);
    for (std::size_t i = 0; i < packs_; ++i) votes += points_[i].drift_circle.lost(left_[i], close);
    return sum(votes);
  }

  double votes() const {
    Number votes(0.0);
    for (std::size_t i = 0; i < packs_; ++i) votes += points_[i].drift_circle.votes;
    return sum(votes);
  }

  CGEMIT_FLATTEN std::optional<Model> moved(const Model& model, double scale) const {
    Sums sums;
    for (std::size_t i = 0; i < packs_; ++i) {
      const Points& points = points_[i];
      sums.add(points, &model, attraction_of(points.drift_circle, left_[i], scale));
    }
    return sums.solve();
  }

  // RANSAC: the curve through a few points, spread along the track, that is closest to most of the others
  // (Fischler and Bolles, CACM 24 (1981) 381).
  std::optional<Model> ransac() {
    std::optional<Model> best;
    double least_lost = HUGE_VAL;
    const std::size_t part = n_ / Shape::least;
    for (std::size_t trial = 0; trial < trials; ++trial) {
      typename Shape::template Sums<double> sums;
      for (std::size_t j = 0; j < Shape::least; ++j) {
        const std::size_t length = j + 1 < Shape::least ? part : n_ - j * part;
        sums.add(point(j * part + (j + 1) * trial % length), nullptr, {0, 1});
      }
      auto model = sums.solve();
      if (!model) continue;
      measure(*model, first);
      model = moved(*model, first);
      if (!model) continue;
      measure(*model, first);
      const double now = lost();
      if (now < least_lost) best = model;
      least_lost = std::min(now, least_lost);
      if (least_lost < enough * votes()) break;
    }
    return best;
  }

  std::array<Points, most / width> points_;
  std::array<Number, most / width> left_;  // mm, distance of the points to the left of the present curve
  std::size_t n_ = 0, packs_ = 0;
};

}  // namespace cgemit

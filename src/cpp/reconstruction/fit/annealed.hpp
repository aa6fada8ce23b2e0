// Robust curve fit to drift circles: distance known, side unknown, some outliers.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>

namespace cgemit {

// The constraint of one point: the curve passes at `drift` from it, and the point lies to its left (side 1),
// right (-1) or either (0).
struct DriftCircle {
  double drift, side;
  double per_error;  // 1/mm, one over the smallest expected error
  double votes;      // its weight when curves are compared
  double left;       // mm, distance of the point to the left of the present curve
  double miss() const { return side == 0 ? std::abs(left) - drift : left - side * drift; }
  // Its votes, in proportion to the part of its distance from the curve beyond `errors` errors.
  double lost(double errors) const {
    const double far = miss() * per_error / errors, square = far * far;
    return votes * square / (1 + square);
  }
};

// The offset to the left of the curve at which the curve should pass, and the weight of this offset.
struct Attraction {
  double offset, weight;
};

// For an unknown side the two possibilities are averaged at the present scale (in errors). Points far outside
// have almost no weight (Geman and McClure, Bull. Int. Stat. Inst. 52 (1987) 5).
inline Attraction attraction_of(const DriftCircle& drift_circle, double scale) {
  const double per_spread = drift_circle.per_error / scale, per_variance = per_spread * per_spread;
  const double far = drift_circle.miss() * per_spread, discount = 1 + far * far / 9;
  if (drift_circle.side != 0)
    return {drift_circle.side * drift_circle.drift, per_variance / (discount * discount)};
  const double certain = drift_circle.drift * drift_circle.left * per_variance,
               square = 1 + certain * certain;
  const double drift2 = drift_circle.drift * drift_circle.drift * per_variance;
  return {drift_circle.drift * certain / std::sqrt(square),
          per_variance * square / ((square + drift2) * discount * discount)};
}

// `Shape` has a Model (the curve), a Point with its DriftCircle, the distance `left` of a point from a model,
// the number of points that determine a model (`least`), and Sums, which take points with their attractions
// and solve for the model.
template <class Shape>
class Annealed {
 public:
  using Model = typename Shape::Model;
  using Point = typename Shape::Point;

  struct Result {
    std::optional<Model> model;
    double scale;  // in errors, the distance of most points from the curve; at least 1
  };

  // Points beyond the capacity are ignored: they would not improve a first helix.
  void add(const Point& point) {
    if (n_ < points_.size()) points_[n_++] = point;
  }

  // Least squares with weights that become sharper as the curve improves. If many points are still lost,
  // RANSAC is tried as well.
  Result result() {
    if (n_ < Shape::least) return {std::nullopt, 0};
    typename Shape::Sums sums;
    for (std::size_t i = 0; i < n_; ++i) {
      const DriftCircle& drift_circle = points_[i].drift_circle;
      const double square = drift_circle.per_error * drift_circle.per_error;
      sums.add(points_[i], nullptr,
               {0, square / (square * drift_circle.drift * drift_circle.drift + first * first)});
    }
    const Result plain = settled(sums.solve());
    const double plain_lost = lost();
    if (!plain.model || plain.scale < 2 || n_ <= Shape::least + 1 || plain_lost < few * votes()) return plain;
    const Result other = settled(ransac());
    return other.model && lost() < 0.9 * plain_lost ? other : plain;
  }

 private:
  static constexpr double first = 20, near = 5;      // errors
  static constexpr double few = 0.05, enough = 0.2;  // of the votes
  static constexpr std::size_t trials = 12;
  static constexpr int passes = 6;

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
  double measure(const Model& model, double scale) {
    double sum = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      DriftCircle& drift_circle = points_[i].drift_circle;
      drift_circle.left = Shape::left(model, points_[i]);
      sum += std::min(std::abs(drift_circle.miss()) * drift_circle.per_error, 1.5 * scale);
    }
    return std::max(1.2 * sum / static_cast<double>(n_), 1.0);
  }

  // Votes of the points that the last measured curve misses.
  double lost() const {
    double sum = 0;
    for (std::size_t i = 0; i < n_; ++i) sum += points_[i].drift_circle.lost(near);
    return sum;
  }

  double votes() const {
    double sum = 0;
    for (std::size_t i = 0; i < n_; ++i) sum += points_[i].drift_circle.votes;
    return sum;
  }

  std::optional<Model> moved(const Model& model, double scale) const {
    typename Shape::Sums sums;
    for (std::size_t i = 0; i < n_; ++i)
      sums.add(points_[i], &model, attraction_of(points_[i].drift_circle, scale));
    return sums.solve();
  }

  // RANSAC: the curve through a few points, spread along the track, that is closest to most of the others
  // (Fischler and Bolles, CACM 24 (1981) 381).
  std::optional<Model> ransac() {
    std::optional<Model> best;
    double least_lost = HUGE_VAL;
    const std::size_t part = n_ / Shape::least;
    for (std::size_t trial = 0; trial < trials; ++trial) {
      typename Shape::Sums sums;
      for (std::size_t j = 0; j < Shape::least; ++j) {
        const std::size_t length = j + 1 < Shape::least ? part : n_ - j * part;
        sums.add(points_[j * part + (j + 1) * trial % length], nullptr, {0, 1});
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

  static constexpr std::size_t most = 128;
  std::array<Point, most> points_;
  std::size_t n_ = 0;
};

}  // namespace cgemit

// How well X and V clusters fit each other by charge and time: logarithms of likelihood ratios, of one
// particle over two (docs/methods/readout.md).
#pragma once

#include <cmath>
#include <cstdint>
#include <span>
#include <unordered_map>
#include <unordered_set>

namespace cgemit {

// Pairs by the numbers of their hits in the input; 0 for pairs that are not listed, such as those of a binary
// readout. A score of infinity is that of a certain pair, which a sensor measures as one point: its X and its
// V have no other partners.
class PairScores {
 public:
  static constexpr double impossible = -100;
  PairScores() = default;
  PairScores(std::span<const std::int64_t> x, std::span<const std::int64_t> v,
             std::span<const double> scores) {
    scores_.reserve(x.size());
    for (std::size_t i = 0; i < x.size(); ++i) {
      const bool certain = std::isinf(scores[i]);
      if (certain) {
        points_x_.insert(x[i]);
        points_v_.insert(v[i]);
      }
      if (scores[i] != 0) scores_.emplace(key(x[i], v[i]), certain ? 0 : scores[i]);
    }
  }
  double of(std::int64_t x, std::int64_t v) const {
    if (scores_.empty()) return 0;
    const auto found = scores_.find(key(x, v));
    if (found != scores_.end()) return found->second;
    return points_x_.contains(x) || points_v_.contains(v) ? impossible : 0;
  }
  // Whether an X or a V is of a certain pair.
  bool is_of_point(std::int64_t hit) const { return points_x_.contains(hit) || points_v_.contains(hit); }

 private:
  static std::uint64_t key(std::int64_t x, std::int64_t v) {
    return (static_cast<std::uint64_t>(x) << 32) | (static_cast<std::uint64_t>(v) & 0xFFFFFFFFU);
  }
  std::unordered_map<std::uint64_t, double> scores_;
  std::unordered_set<std::int64_t> points_x_, points_v_;
};

}  // namespace cgemit

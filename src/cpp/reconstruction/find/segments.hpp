// Seeds from the CGEM alone: pairs of X and V clusters in three layers, or in two and the beam line.
#pragma once

#include <array>
#include <cmath>
#include <optional>
#include <span>
#include <vector>

#include "reconstruction/find/event_hits.hpp"
#include "reconstruction/find/find.hpp"
#include "reconstruction/find/follower.hpp"
#include "reconstruction/find/score.hpp"
#include "reconstruction/find/segment_score.hpp"

namespace cgemit {

// Of a seed from clusters.
inline double variance_of_kappa(double kappa) {
  const double sigma = 2 + 0.3 * std::abs(kappa);
  return sigma * sigma;
}

class SegmentFinder {
 public:
  SegmentFinder(const Detector& detector, const FindSettings& settings);

  // Seeds of three layers, neighbours but for one between them at most, or of two with the beam line as a
  // third point; the best ones first. Taken clusters are left out of those of two layers, and of those of
  // three unless `all` count.
  const std::vector<FindSeed>& three_layers(const EventHits& hits, bool all);
  const std::vector<FindSeed>& two_layers(const EventHits& hits);
  // In a detector of three layers alone, a segment is all that a track has: those with three or two heights
  // in order of their scores, without those that chance explains as well.
  const std::vector<FindSeed>& tracks(const EventHits& hits);
  // Whether the last call left out combinations or seeds.
  bool is_cut() const { return too_much() || dropped_; }

 private:
  using Layers = std::array<std::size_t, 3>;  // from the beam line outward
  struct Point {
    double x, y, phi;
    std::int32_t id;
  };
  struct Height {
    double z, score;  // of the pair
    std::int32_t id;
  };
  struct Range {
    std::size_t first, last;
  };
  // Through three X clusters; arc lengths from the closest approach to the beam line.
  struct Circle {
    std::array<std::int32_t, 3> x;
    std::array<double, 3> s;
    double d, psi, kappa;
    double most_z;  // of the line at s = 0
  };
  struct Ranked {
    double rank;
    std::size_t seed;
  };

  void load(const EventHits& hits, bool all);
  Range heights(const EventHits& hits, std::size_t layer, const Point& point);
  std::span<const Height> of(const Range& range) const {
    return std::span(made_).subspan(range.first, range.last - range.first);
  }
  bool three_of(const Layers& layers, const EventHits& hits);
  void three(const Layers& layers, const Point& a, const Point& b, const Point& c, const EventHits& hits);
  bool may_hold_line(const Layers& layers, const Point& a, const Point& b, const Point& c,
                     const EventHits& hits);
  void lines_of_three(const Circle& circle);
  // Through heights in two layers, without one in the third.
  void lines_of_two(const Circle& circle, std::size_t first, std::size_t second);
  void two(std::size_t inner, std::size_t outer, const Point& a, const Point& c, const EventHits& hits);
  void add(const Perigee& helix, double sigma_d, std::vector<std::int32_t> hits, double rank);
  void keep_best();
  std::size_t most_kept() const { return 4 * static_cast<std::size_t>(settings_.max_seeds); }
  const std::vector<FindSeed>& ranked();
  double least_score() const { return alone_ ? settings_.min_score : hopeless; }
  bool too_much() const { return work_ > most_work; }

  const Detector& detector_;
  const FindSettings& settings_;
  std::vector<Layers> threes_;
  std::vector<LayerPair> twos_;
  double largest_w_;  // 1/mm, of the smallest transverse momentum
  std::vector<std::vector<Point>> points_;
  std::array<std::span<const Height>, 3> heights_;  // of the clusters of a circle or pair
  // Those of each X cluster, made when it is first needed, since a cluster is in many circles.
  std::vector<Height> made_;
  std::vector<std::optional<Range>> range_;
  SegmentScore score_;
  bool all_ = true;     // taken clusters count
  bool alone_ = false;  // segments are tracks
  std::vector<FindSeed> seeds_, sorted_;
  std::vector<Ranked> ranks_;
  std::vector<std::uint8_t> in_better_;  // of each cluster, whether a better seed has it
  // Combinations that have been looked at in this event; no more than a second's worth.
  static constexpr std::int64_t most_work = 100'000'000;
  std::int64_t work_ = 0;
  bool dropped_ = false;  // seeds beyond `most_kept`
};

}  // namespace cgemit

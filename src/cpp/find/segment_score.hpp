// The likelihood of three clusters in X and three or two in V, as those of one particle over foreign ones: a
// circle and a line in closed form, without a trace.
#pragma once

#include <array>
#include <cmath>
#include <vector>

#include "find/event_hits.hpp"
#include "find/find.hpp"

namespace cgemit {

class SegmentScore {
 public:
  using Three = std::array<double, 3>;

  SegmentScore(const Detector& detector, const FindSettings& settings);

  // Before each event.
  void start(const EventHits& hits);

  // A circle through X clusters of three layers, whose points have arc lengths `s` from the closest approach
  // to the beam line. The scores below are of lines on this circle.
  void circle(const std::array<std::size_t, 3>& layers, const std::array<std::int32_t, 3>& x, const Three& s,
              double d, double kappa);

  // A line z = z0 + tanl s on the circle.
  struct Line {
    double scattered_z;  // mm2, of the middle height
    double near;         // the part of the score for the closest approach
    double tanl;
  };
  Line line(double z0, double tanl) const;
  // Whether no particle has its middle height so far from the line of the others, in mm.
  bool is_far(const Line& line, double off) const;
  double of_three(const Line& line, const std::array<std::int32_t, 3>& v, double off) const;
  // Of heights in two of the layers.
  double of_two(const Line& line, std::size_t first, std::size_t second) const;

 private:
  double height_variance(std::size_t i, std::int32_t v) const;
  double near(double variance_d, double z0) const;
  double along_line(std::size_t first, std::size_t second) const;

  const Detector& detector_;
  const FindSettings& settings_;
  const EventHits* hits_ = nullptr;
  double log_found_, log_missed_;
  std::vector<std::array<double, 2>> gain_;  // of a hit in each layer, X and V, without its residual
  // Of the circle:
  std::array<std::size_t, 3> layers_{};
  std::array<std::int32_t, 3> x_{};
  Three s_{};
  double d_ = 0, pt_ = 0;
  double measured_d_ = 0, scattered_d_ = 0;  // mm2, and mm2 for a scatter of 1 rad in each layer
  double of_x_ = 0;                          // the part of the score that is the same for all lines
};

}  // namespace cgemit

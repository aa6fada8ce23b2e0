// The likelihood of three clusters in X and three or two in V, as those of one particle over foreign ones: a
// circle and a line in closed form, without a trace.
#pragma once

#include <array>
#include <cmath>
#include <vector>

#include "reconstruction/find/event_hits.hpp"
#include "reconstruction/find/find.hpp"

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

  // Scatters of a particle on a line z = z0 + tanl s on the circle, as rad2, and mm2 of the middle height.
  struct Scatter {
    double angle, middle;
  };
  Scatter scatter(double tanl) const { return scatter(pt_, s_[2] - s_[1], tanl); }
  // Whether no line on a circle of this curvature or less has its middle height at least so far off, in mm.
  // Upper bounds: curvature, arc length from the middle to the outer point, slope of the line.
  bool is_hopeless(double kappa, double arc, double tanl, double off) const {
    constexpr double rounding = 1e-6;
    return is_far(scatter(pt_of(kappa), arc, tanl), (1 - rounding) * off);
  }
  // Whether no particle has its middle height so far from the line of the others, in mm.
  bool is_far(const Scatter& scatter, double off) const;
  // An upper bound, if that is below `least`.
  double of_three(const Scatter& scatter, const std::array<std::int32_t, 3>& v, double off, double z0,
                  double least) const;
  // Of heights in two of the layers.
  double of_two(const Scatter& scatter, std::size_t first, std::size_t second, double z0) const;
  // Upper bounds, which cost little.
  double most_of_three(double z0) const;
  double most_of_two(std::size_t first, std::size_t second, double z0) const;

 private:
  double pt_of(double kappa) const;
  Scatter scatter(double pt, double arc, double tanl) const;
  double height_variance(std::size_t i, std::int32_t v) const;
  double near(const Scatter& scatter, double z0) const;
  double most_near(double z0) const;

  const Detector& detector_;
  const FindSettings& settings_;
  const EventHits* hits_ = nullptr;
  double log_found_, log_missed_, log_prompt_, log_elsewhere_;
  std::vector<std::array<double, 2>> gain_;  // of a hit in each layer, X and V, without its residual
  // Of the circle:
  std::array<std::size_t, 3> layers_{};
  std::array<std::int32_t, 3> x_{};
  Three s_{};
  double d_ = 0, pt_ = 0;
  double measured_d_ = 0, scattered_d_ = 0;  // mm2, and mm2 for a scatter of 1 rad in each layer
  double most_near_d_ = 0;                   // logarithm of the density of d of particles from the beam line
  // Parts of the score that are the same for all lines: with three heights, and with two, by the layer of the
  // third.
  double of_three_ = 0;
  Three of_two_{};
};

}  // namespace cgemit

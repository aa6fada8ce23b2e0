// The line z = z0 + tanl s of a circle: heights at which stereo wires and V strips lie on it.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "reconstruction/find/axial.hpp"
#include "reconstruction/find/bit_counts.hpp"

namespace cgemit {

struct FoundLine {
  double z0, tanl;
  std::array<double, 3> covariance;  // of both
  int layers;
  double dw = 0;  // 1/mm, change of the curvature of the circle
};

// Change of d and psi of a circle with its curvature, by the covariance of its fit.
struct CircleSlope {
  double d, psi;
  explicit CircleSlope(const FoundCircle& circle)
      : d(circle.covariance[2] / circle.covariance[5]), psi(circle.covariance[4] / circle.covariance[5]) {}
};

class StereoSearch {
 public:
  StereoSearch(const Detector& detector, const FindSettings& settings);

  // Up to `most` lines through measurements of at least two layers that are not taken, the best one first.
  void start() { cut_ = false; }
  // `bend`: where no line has nearly all layers, the curvature of the circle is a third parameter of the
  // lines. A circle of inner layers alone is uncertain by many mm in outer ones, which a small stereo angle
  // turns into hundreds of mm of z, of opposite signs for the two signs of the angle.
  const std::vector<FoundLine>& find(const FoundCircle& circle, const EventHits& hits, std::size_t most,
                                     bool bend);

  // Whether heights were left out since `start`.
  bool is_cut() const { return cut_; }

 private:
  static constexpr int slopes = 128, bins = 64;

  struct Height {
    double s, z, error;
    std::uint64_t layer;
    double lever;  // mm^2, dz/dw
  };

  void wires(const FoundCircle& circle, const EventHits& hits);
  void strips(const FoundCircle& circle, const EventHits& hits);
  void strips_alone(const FoundCircle& circle, const EventHits& hits);
  void count(double dw);
  // Lines of the boxes with most layers, for a change of the curvature.
  template <class Fit>
  void lines(std::size_t most, double dw, const Fit& fit);
  void bent_lines(const FoundCircle& circle, std::size_t most);
  std::optional<FoundLine> bent(const FoundLine& first, double sigma_w, double& score) const;
  std::optional<FoundLine> line(double z0, double tanl) const;

  const Detector& detector_;
  const FindSettings& settings_;
  std::vector<Height> heights_;
  BitCounts<slopes> counts_;  // a word for each slope: the layers in each bin of z0
  std::vector<FoundLine> lines_;
  struct Scored {
    FoundLine line;
    double score;
  };
  std::vector<Scored> scored_;
  bool cut_ = false;
};

}  // namespace cgemit

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
};

class StereoSearch {
 public:
  StereoSearch(const Detector& detector, const FindSettings& settings);

  // Up to `most` lines through measurements of at least two layers that are not taken, the best one first.
  void start() { cut_ = false; }
  const std::vector<FoundLine>& find(const FoundCircle& circle, const EventHits& hits, std::size_t most);

  // Whether heights were left out since `start`.
  bool is_cut() const { return cut_; }

 private:
  static constexpr int slopes = 128, bins = 64;

  struct Height {
    double s, z, error;
    std::uint64_t layer;
  };

  void wires(const FoundCircle& circle, const EventHits& hits);
  void strips(const FoundCircle& circle, const EventHits& hits);
  void strips_alone(const FoundCircle& circle, const EventHits& hits);
  void count();
  std::optional<FoundLine> line(double z0, double tanl) const;

  const Detector& detector_;
  const FindSettings& settings_;
  std::vector<Height> heights_;
  BitCounts<slopes> counts_;  // a word for each slope: the layers in each bin of z0
  std::vector<FoundLine> lines_;
  bool cut_ = false;
};

}  // namespace cgemit

// Circles of tracks from anywhere: short segments in neighbouring axial layers (or layers of one stereo
// sign), each continued by the curvature that most other such hits share; where layers measure one coordinate
// each, circles through X clusters of three layers, too.
//
// A segment touches the drift circles of two wires. A circle through both points of contact, which are
// `chord` apart, touches a drift circle (x, y, l) if w = 2 (a -+ l)/(x^2 + y^2 - l^2 - chord^2/4), x and y
// from the middle of the chord and a to the left of it. So a histogram of w is enough, with no point of
// origin.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "reconstruction/find/axial_hits.hpp"
#include "reconstruction/find/bit_counts.hpp"

namespace cgemit {

class DisplacedSearch {
 public:
  DisplacedSearch(const Detector& detector, AxialHits& axial);

  // Begins with the hits that `axial` holds.
  void start(const EventHits& hits);
  // The circle with the most layers; its hits are left out afterwards. None: too few layers.
  std::optional<FoundCircle> next();
  // Whether segments were left out that might lead to circles.
  bool is_cut() const { return cut_; }

 private:
  static constexpr int bins = 200;
  static constexpr std::size_t words = (bins + 63) / 64;
  static constexpr std::size_t most_segments = 2000;

  // Four neighbouring layers, and two of them by their numbers in the ring.
  static constexpr std::size_t ring_layers = 4;
  using Ring = std::array<std::size_t, ring_layers>;
  struct Ends {
    const Ring& ring;
    std::size_t inner, outer;
  };
  struct Circle {
    double x, y, drift;
  };
  struct Segment {
    double x, y, ux, uy, chord;  // its middle and direction, outward
    std::uint64_t layers;
    double off;  // mm, of the hits between its ends
  };
  struct Range {
    double w, error;
  };
  struct Curve {
    int layers;
    double far;  // mm, |d| of a circle through clusters: the closer ones are likelier
    double d, psi, w;
    int more;  // layers than a circle from the beam line needs
  };

  void pairs(const Ends& ends, const EventHits& hits);
  void tangents(const Ends& ends, const Circle& a, const Circle& b, const EventHits& hits);
  std::optional<double> closest(const Segment& segment, std::size_t layer, const EventHits& hits) const;
  void count(const Segment& segment);
  static int straightest(const BitCounts<words>::Bits& among);
  void continued(const Segment& segment);
  void through_clusters(const EventHits& hits);
  int layers_on(double d, double psi, double w, std::span<const AxialPoint> points) const;

  const Detector& detector_;
  AxialHits& axial_;
  double most_curved(double r) const;

  bool single_;  // whether there are layers of one coordinate, which make no segments of the other search
  std::vector<Ring> rings_;
  std::vector<Segment> segments_;
  std::vector<Range> ranges_;
  std::vector<Curve> curves_;
  BitCounts<words> counts_;  // layers of each bin of w
  std::size_t next_ = 0;
  bool cut_ = false;
};

}  // namespace cgemit

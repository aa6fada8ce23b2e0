// Circles from the beam line that touch many drift circles of axial wires (and pass X clusters), by division
// of the plane of azimuth and curvature.
//
// A circle through the beam line with flight azimuth psi and curvature w touches the drift circle (x, y, l)
// on one of its sides if w = 2 (y cos psi - x sin psi -+ l)/(r^2 - l^2): two sinusoids a hit. (T. Alexopoulos
// et al., NIM A 592 (2008) 456; Belle II tracking, CPC 259 (2021) 107610.) Only the half turn that leaves the
// beam line counts.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "find/event_hits.hpp"
#include "find/find.hpp"

namespace cgemit {

// A circle with the covariance of (d, psi, w).
struct FoundCircle {
  double d, psi, w;
  std::array<double, 6> covariance;  // upper triangle
  std::vector<std::int32_t> hits;
};

class AxialSearch {
 public:
  AxialSearch(const Detector& detector, const FindSettings& settings);

  // Takes over the axial hits that are not taken.
  void load(const EventHits& hits);
  // The circle with the most layers; its hits are left out afterwards. None: too few layers.
  std::optional<FoundCircle> next();

 private:
  static constexpr int columns = 64, rows = 64;

  struct Point {
    double x, y, drift, per;  // per: 2/(r^2 - l^2)
    double phi;
    std::uint64_t layer;  // one bit
    std::int32_t id;
    bool left_out;
  };
  struct Box {
    int layers, depth;
    double psi, w;             // lowest corner
    std::int32_t first, last;  // its points in the arena
  };

  void add(double x, double y, double drift, std::size_t layer, std::int32_t id);
  void coarse();
  bool touches(const Point& point, double psi, double w, int depth) const;
  void divide(const Box& box);
  void push(double psi, double w, int depth, std::int32_t first, std::int32_t last);
  std::optional<FoundCircle> circle(double psi, double w);
  int deepest(double w) const;
  double residual(const FoundCircle& c, const Point& p) const;

  const Detector& detector_;
  const FindSettings& settings_;
  double largest_w_;
  std::vector<Point> points_;
  std::vector<std::uint64_t> grid_;
  std::vector<Box> heap_;
  std::vector<std::int32_t> arena_;
};

}  // namespace cgemit

// Circles from the beam line that touch many drift circles of axial wires (and pass X clusters), by division
// of the plane of azimuth and curvature.
//
// A circle through the beam line with flight azimuth psi and curvature w touches the drift circle (x, y, l)
// on one of its sides if w = 2 (y cos psi - x sin psi -+ l)/(r^2 - l^2): two sinusoids a hit. (T. Alexopoulos
// et al., NIM A 592 (2008) 456; Belle II tracking, CPC 259 (2021) 107610.) Only the half turn that leaves the
// beam line counts.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <optional>
#include <tuple>
#include <vector>

#include "reconstruction/find/axial_hits.hpp"

namespace cgemit {

class AxialSearch {
 public:
  AxialSearch(const Detector& detector, AxialHits& hits);

  // Begins with the hits of another event.
  void start();
  // The circle with the most layers; its hits are left out afterwards. None: too few layers.
  std::optional<FoundCircle> next();
  // Whether boxes were left that might hold circles.
  bool is_cut() const { return divided_ >= limit() && !heap_.empty(); }

 private:
  static constexpr int most_boxes = 1200;                                      // divided in one grid
  int limit() const { return hits_.is_view() ? 4 * most_boxes : most_boxes; }  // smaller boxes

  struct Box {
    int layers, depth;
    double psi, w;             // lowest corner
    std::int32_t first, last;  // its points in the arena; first < 0: not collected yet
    int counted;               // circles that had been found when its layers were counted

    bool operator<(const Box& other) const {
      return std::tuple(layers, depth, -psi, -w) <
             std::tuple(other.layers, other.depth, -other.psi, -other.w);
    }
  };
  // The edges of a column of boxes.
  struct Column {
    double cos_low, sin_low, cos_high, sin_high;
    Column(double psi, double width)
        : cos_low(std::cos(psi)),
          sin_low(std::sin(psi)),
          cos_high(std::cos(psi + width)),
          sin_high(std::sin(psi + width)) {}
    // Up to `end`, beginning where another one ends.
    Column(const Column& before, double end)
        : cos_low(before.cos_high),
          sin_low(before.sin_high),
          cos_high(std::cos(end)),
          sin_high(std::sin(end)) {}
    // Whether the point is on the half turn that leaves the beam line.
    bool outward(const AxialPoint& p) const {
      return p.x * (cos_low + cos_high) + p.y * (sin_low + sin_high) > 0;
    }
    double at_low(const AxialPoint& p) const { return p.y * cos_low - p.x * sin_low; }
    double at_high(const AxialPoint& p) const { return p.y * cos_high - p.x * sin_high; }
  };
  // The curvatures that the two curves of a hit have within a column.
  struct Curves {
    std::array<double, 2> low, high;
    Curves(const AxialPoint& p, const Column& column) {
      const double one = column.at_low(p), other = column.at_high(p);
      const double least = std::min(one, other), most = std::max(one, other);
      low = {(least - p.drift) * p.per, (least + p.drift) * p.per};
      high = {(most - p.drift) * p.per, (most + p.drift) * p.per};
    }
    bool cross(double from, double to) const {
      return ((high[0] >= from) & (low[0] <= to)) | ((high[1] >= from) & (low[1] <= to));
    }
  };
  static constexpr std::size_t block = 32;  // columns that are filled together, at most half of a grid
  struct Edges {
    std::array<float, block + 1> cosine, sine;
  };

  void make_grid();
  bool is_stale() const;
  template <std::size_t words>
  void fill();
  template <std::size_t words>
  void cross(const AxialPoint& point, const Edges& edges, std::size_t from, std::size_t to,
             std::array<std::uint64_t, block * words>& crossed) const;
  void collect(Box& box);
  void divide(const Box& box);
  void push(const Box& box);
  bool is_worth(const Box& box) const;
  int layers_in(const Box& box) const;
  int deepest(double w) const;

  const Detector& detector_;
  AxialHits& hits_;
  std::vector<AxialPoint>& points_;
  double largest_w_;
  double radius_ = 0;  // mm, of the outermost wires
  // Of each point: between its two sides it has the curvature y cos psi - x sin psi, 1/mm. `reach`: how far
  // the middle of a box of the first grid is from that at most, if one of its curves crosses the box.
  struct Bands {
    std::vector<float> x, y, reach;
    void clear() {
      x.clear();
      y.clear();
      reach.clear();
    }
  };
  Bands bands_;
  std::vector<std::uint8_t> near_;
  std::vector<int> begins_;  // of each point, its first column in the first grid
  std::vector<Box> heap_;
  std::vector<std::int32_t> arena_;
  int first_depth_ = 0;  // of the boxes of the first grid
  int divided_ = 0, circles_ = 0;
};

}  // namespace cgemit

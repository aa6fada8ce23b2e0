// Which drift cells of a layer a track passes.
#pragma once

#include <algorithm>
#include <cmath>

#include "simulate/cells_at_once.hpp"

namespace cgemit {

// Cells from first to last, both included, to be taken modulo the cells of the layer.
struct CellRange {
  int first, last;
  HelixPoint at_wires;  // where the track is at the radius of the wires, or nearest to it
  double arc;           // mm, transverse path to there
};

// For one track, asked layer by layer on its way out. `Motion`: in the field that it flies through.
template <class Motion>
class CellFinder {
 public:
  CellFinder(const Detector& detector, Motion& motion) : wires_(detector.wires), motion_(motion) {}

  // Every cell between the radial borders, which lie midway to the neighbouring layers at the track's z.
  // False if the track turns back below them.
  bool find(std::size_t index, const HelixPoint& from, CellRange& range) {
    const WireLayer& layer = wires_[index];
    range.at_wires = from;
    const bool reached = motion_.to_cylinder(range.at_wires, wire_radius(layer, from.z), range.arc);
    if (motion_.left()) return false;
    if (!reached) motion_.to_apex(range.at_wires, range.arc);
    const CellBorders<double> borders(wires_, index, range.at_wires.z);
    return (reached && at_once_.find(layer, borders, range.at_wires, true, range.first, range.last)) ||
           step_by_step(layer, from, borders.inner, borders.outer, range);
  }

 private:
  bool step_by_step(const WireLayer& layer, const HelixPoint& start, double inner, double outer,
                    CellRange& range) const {
    double arc = 0;
    HelixPoint from = start, to = range.at_wires;
    if (!motion_.to_cylinder(from, inner, arc)) return false;
    if (!motion_.to_cylinder(to, outer, arc)) {
      const double ahead = arc_to_apex(to);
      if (ahead * std::abs(to.w) < pi) advance(to, ahead);
    }
    const double first = cell_coordinate(layer, std::atan2(from.y, from.x), from.z);
    const double last = first + cells_between(layer, from, to);
    range.first = nearest_cell(std::min(first, last));
    range.last = std::min(nearest_cell(std::max(first, last)), range.first + most_cells);
    return true;
  }

  // Cells that the azimuth relative to the wires passes from one point to another.
  static double cells_between(const WireLayer& layer, const HelixPoint& a, const HelixPoint& b) {
    const double cross = a.x * b.y - a.y * b.x, dot = a.x * b.x + a.y * b.y;
    const double turn = dot > 0 ? cross / dot * atan_over(cross / dot) : std::atan2(cross, dot);
    const double twist = wire_azimuth(layer, b.z) - wire_azimuth(layer, a.z);
    return (turn - twist) * layer.per_radian;
  }

  const std::vector<WireLayer>& wires_;
  Motion& motion_;
  CellsAtOnce<double> at_once_;
};

}  // namespace cgemit

// Which drift cells of a layer a track passes.
#pragma once

#include <algorithm>
#include <cmath>
#include <utility>

#include "detector/wires.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// Cells from first to last, both included, to be taken modulo the cells of the layer.
struct CellRange {
  int first, last;
  HelixPoint at_wires;  // where the track is at the radius of the wires, or nearest to it
  double arc;           // mm, transverse path to there
};

// For one track, asked layer by layer on its way out.
class CellFinder {
 public:
  explicit CellFinder(const Detector& detector) : wires_(detector.wires) {}

  // Every cell between the radial borders, which lie midway to the neighbouring layers at the track's z.
  // False if the track turns back below them.
  bool find(std::size_t index, const HelixPoint& from, CellRange& range) {
    const WireLayer& layer = wires_[index];
    range.at_wires = from;
    const bool reached = step_to_cylinder(range.at_wires, wire_radius(layer, from.z), range.arc);
    if (!reached) {
      range.arc = arc_to_apex(from);
      advance(range.at_wires, range.arc);
    }
    const auto [inner, outer] = borders(index, range.at_wires.z);
    return (reached && at_once(layer, inner, outer, range)) || step_by_step(layer, from, inner, outer, range);
  }

 private:
  static constexpr int most_cells = 64;  // a particle that runs along a layer fires no more
  static constexpr int many_cells = 1 << 20;
  static int nearest(double c) { return static_cast<int>(c + (many_cells + 0.5)) - many_cells; }

  // From the slope of the track at the wires; false where its bend could make a difference.
  bool at_once(const WireLayer& layer, double inner, double outer, CellRange& range) {
    const HelixPoint& middle = range.at_wires;
    const double p = middle.outward();
    if (!(p > 0)) return false;
    const double radius = middle.radius(), per_p = 1 / p, per_radius = 1 / radius;
    const double tan_a = middle.sideways() * per_p, per_cos = radius * per_p, twist = layer.twist_per_z;
    const double at = cell_coordinate(layer, azimuth_of(middle), middle.z);
    const double slope = (tan_a * per_radius - twist * middle.tanl * per_cos) * layer.per_radian;
    const double height = std::max(radius - inner, outer - radius), w = std::abs(middle.w);
    const double bend = (w + 2 * std::abs(tan_a) * per_radius) * per_cos * per_cos * per_cos * per_radius +
                        std::abs(twist * middle.tanl) * (w * per_cos + std::abs(twist)) * per_cos;
    const double unsure = 1e-9 + bend * height * height * layer.per_radian;
    const double one = at + (inner - radius) * slope, other = at + (outer - radius) * slope;
    const double low = std::min(one, other), high = std::max(one, other);
    if (!(std::abs(low) < many_cells && high - low < most_cells)) return false;
    range.first = nearest(low);
    range.last = nearest(high);
    const auto sure = [unsure](double c, int cell) { return 0.5 - std::abs(c - cell) > unsure; };
    return sure(low, range.first) && sure(high, range.last);
  }

  static bool step_by_step(const WireLayer& layer, const HelixPoint& start, double inner, double outer,
                           CellRange& range) {
    double arc = 0;
    HelixPoint from = start, to = range.at_wires;
    if (!step_to_cylinder(from, inner, arc)) return false;
    if (!step_to_cylinder(to, outer, arc)) {
      const double ahead = arc_to_apex(to);
      if (ahead * std::abs(to.w) < pi) advance(to, ahead);
    }
    const double first = cell_coordinate(layer, std::atan2(from.y, from.x), from.z);
    const double last = first + cells_between(layer, from, to);
    range.first = nearest(std::min(first, last));
    range.last = std::min(nearest(std::max(first, last)), range.first + most_cells);
    return true;
  }

  // Counted on from the last point that was asked for: between wire layers the turn is small.
  double azimuth_of(const HelixPoint& at) {
    const double cross = last_x_ * at.y - last_y_ * at.x, dot = last_x_ * at.x + last_y_ * at.y;
    const bool ahead = dot > 0 && std::abs(cross) < dot;
    azimuth_ = ahead ? azimuth_ + cross / dot * atan_over(cross / dot) : std::atan2(at.y, at.x);
    last_x_ = at.x;
    last_y_ = at.y;
    return azimuth_;
  }

  // Cells that the azimuth relative to the wires passes from one point to another.
  static double cells_between(const WireLayer& layer, const HelixPoint& a, const HelixPoint& b) {
    const double cross = a.x * b.y - a.y * b.x, dot = a.x * b.x + a.y * b.y;
    const double turn = dot > 0 ? cross / dot * atan_over(cross / dot) : std::atan2(cross, dot);
    const double twist = wire_azimuth(layer, b.z) - wire_azimuth(layer, a.z);
    return (turn - twist) * layer.per_radian;
  }

  std::pair<double, double> borders(std::size_t index, double z) const {
    const double here = wire_radius(wires_[index], z);
    const double below = index > 0 ? wire_radius(wires_[index - 1], z) : -HUGE_VAL;
    const double above = index + 1 < wires_.size() ? wire_radius(wires_[index + 1], z) : HUGE_VAL;
    double half_in = 0.5 * (here - below), half_out = 0.5 * (above - here);
    if (index == 0) half_in = std::min(half_out, pi * here / wires_[index].cells);
    if (index + 1 == wires_.size()) half_out = std::min(half_in, pi * here / wires_[index].cells);
    return {here - half_in, here + half_out};
  }

  const std::vector<WireLayer>& wires_;
  double last_x_ = 0, last_y_ = 0, azimuth_ = 0;
};

}  // namespace cgemit

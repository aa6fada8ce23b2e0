// The drift cells of a layer that tracks cross: for one track, or one per lane.
#pragma once

#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <vector>

#include "common/compiler.hpp"
#include "common/lanes/integers.hpp"
#include "detector/wires.hpp"
#include "motion/helix.hpp"

namespace cgemit {

inline constexpr int most_cells = 64;  // a particle that runs along a layer fires no more
inline constexpr int many_cells = 1 << 20;
inline double nearest_cell(double c) { return static_cast<int>(c + (many_cells + 0.5)) - many_cells; }
template <class T>
T nearest_cell(const T& c) {
  return nearest(c);
}

// Radial borders of a layer's cells, midway to the neighbouring layers at the track's z; as far on the other
// side where there is no neighbour.
template <class T>
struct CellBorders {
  T inner, outer;

  CellBorders(const std::vector<WireLayer>& wires, std::size_t index, const T& z) {
    const T here = wire_radius(wires[index], z);
    const T below = index > 0 ? wire_radius(wires[index - 1], z) : T(-HUGE_VAL);
    const T above = index + 1 < wires.size() ? wire_radius(wires[index + 1], z) : T(HUGE_VAL);
    T half_in = 0.5 * (here - below), half_out = 0.5 * (above - here);
    const bool ends_in = index > 0 && wires[index - 1].has_borders(),
               ends_out = index + 1 < wires.size() && wires[index + 1].has_borders();
    if (ends_in) half_in = select(wires[index - 1].borders.miss(z), T(HUGE_VAL), half_in);
    if (ends_out) half_out = select(wires[index + 1].borders.miss(z), T(HUGE_VAL), half_out);
    if (index == 0 || ends_in)
      half_in = select(half_in < HUGE_VAL, half_in, smaller(half_out, pi * here / wires[index].cells));
    if (index + 1 == wires.size() || ends_out)
      half_out = select(half_out < HUGE_VAL, half_out, smaller(half_in, pi * here / wires[index].cells));
    inner = here - half_in;
    outer = here + half_out;
  }
};

// Cells from first to last, both included; cell numbers are modulo the number of cells of the layer.
template <class T, class Point>
struct CellRange {
  T first{0.0}, last{0.0};
  Point at_wires;  // point of the track at the radius of the wires, or closest to it
  T arc{0.0};      // mm, transverse path to this point
};

// The number of a cell for each lane, and its wire. `count`: a whole number, modulo the number of cells.
template <class T>
using CellNumbers = std::array<std::int64_t, static_cast<std::size_t>(lanes_of<T>)>;
template <class T>
CellNumbers<T> cell_numbers(const WireLayer& layer, const T& count) {
  const T cells(layer.cells);
  T cell = count - cells * nearest(count * (1.0 / layer.cells));
  cell = select(cell < 0.0, cell + cells, cell);
  return std::bit_cast<CellNumbers<T>>(whole(cell));
}
template <class T>
WireOf<T> cell_wires(const WireLayer& layer, const CellNumbers<T>& number) {
  const auto placed = [&](double Wire::* value) {
    return gathered<T>([&](int i) {
      return layer.placed[static_cast<std::size_t>(number[static_cast<std::size_t>(i)])].*value;
    });
  };
  return {placed(&Wire::x), placed(&Wire::y), placed(&Wire::ex), placed(&Wire::ey), placed(&Wire::ez)};
}

// Cells of a layer, as real numbers: where a track crosses the borders, from its slope at the wires.
template <class T>
struct CellSpan {
  T low, high;
  T unsure;        // bound of what the curvature of the track changes
  mask_of<T> few;  // lanes for which this is a bound

  // The cells that a track crosses which is turned about the beam line by a number of cells, and the lanes
  // for which they are certain.
  template <class U>
  mask_of<U> cells(const U& turn, U& first, U& last) const {
    if (!any(few)) return mask_of<U>(false);
    const U from = low + turn, to = high + turn;
    first = nearest_cell(from);
    last = nearest_cell(to);
    return mask_of<U>(few) & (0.5 - abs(from - first) > unsure) & (0.5 - abs(to - last) > unsure);
  }
};

// Called layer by layer, outward. `Motion`: motion in the field.
template <class T, class Motion>
class CellFinder {
 public:
  using Mask = mask_of<T>;
  using Point = typename Motion::Point;

  CellFinder(const Detector& detector, Motion& motion) : wires_(detector.wires), motion_(motion) {}

  // Finds every cell between the radial borders, for the tracks `who` that neither turn back below them nor
  // stay beyond the wires.
  Mask find(std::size_t index, const Point& from, const Mask& who, CellRange<T, Point>& range) {
    const WireLayer& layer = wires_[index];
    range.at_wires = from;
    const T cylinder = wire_radius(layer, from.z);
    const Mask reached = motion_.to_wires(range.at_wires, cylinder, range.arc, who);
    left_ = who & motion_.left();
    Mask ahead = who & !left_;
    if (const Mask missed = ahead & !reached; any(missed)) {
      ahead = ahead & (reached | (from.radius() < cylinder));
      const Mask turns = missed & ahead;
      T arc(0.0);
      motion_.to_apex(range.at_wires, arc, turns);
      range.arc = select(turns, arc, range.arc);
    }
    const CellBorders<T> borders(wires_, index, range.at_wires.z);
    Mask found = reached;
    if (any(reached))
      found =
          by_slope(layer, borders, cylinder, reached, range.at_wires).cells(T(0.0), range.first, range.last);
    const Mask others = ahead & !found;
    return any(others) ? found | step_by_step(layer, from, borders, others, range) : found;
  }
  // The borders' crossings by tracks that are at the wires' distance from the beam line, `radius`.
  CellSpan<T> span(std::size_t index, const HelixPointOf<T>& at, const T& radius, const Mask& who) {
    return by_slope(wires_[index], CellBorders<T>(wires_, index, at.z), radius, who, at);
  }
  // Tracks that left the field map instead.
  const Mask& left() const { return left_; }

 private:
  CellSpan<T> by_slope(const WireLayer& layer, const CellBorders<T>& borders, const T& radius,
                       const Mask& who, const HelixPointOf<T>& middle) {
    const T p = middle.outward(), per_both = 1.0 / (p * radius), per_radius = p * per_both;
    const T per_cos = radius * radius * per_both, tan_a = middle.sideways() * radius * per_both;
    const T twist_tanl = layer.twist_per_z * middle.tanl;
    const T at = cell_coordinate(layer, azimuth_of(middle, who), middle.z);
    const T slope = (tan_a * per_radius - twist_tanl * per_cos) * layer.per_radian;
    const T height = larger(radius - borders.inner, borders.outer - radius), w = abs(middle.w);
    const T bend = (w + 2.0 * abs(tan_a) * per_radius) * per_cos * per_cos * per_cos * per_radius +
                   abs(twist_tanl) * (w * per_cos + std::abs(layer.twist_per_z)) * per_cos;
    const T unsure = 1e-9 + bend * height * height * layer.per_radian;
    const T one = at + (borders.inner - radius) * slope, other = at + (borders.outer - radius) * slope;
    const T low = smaller(one, other), high = larger(one, other);
    return {low, high, unsure,
            mask_of<T>(who & (p > 0.0) & (abs(low) < many_cells) & (high - low < most_cells))};
  }

  // Azimuth continued from the previous point: between wire layers the turn is small.
  T azimuth_of(const HelixPointOf<T>& at, const Mask& who) {
    const T cross = last_x_ * at.y - last_y_ * at.x, dot = last_x_ * at.x + last_y_ * at.y;
    const Mask ahead = (dot > 0.0) & (abs(cross) < dot);
    const auto counted = [&] {
      const T turn = cross / dot;
      return azimuth_ + turn * atan_over(turn);
    };
    azimuth_ = select(who, choose(ahead | !who, counted, [&] { return atan2(at.y, at.x); }), azimuth_);
    last_x_ = select(who, at.x, last_x_);
    last_y_ = select(who, at.y, last_y_);
    return azimuth_;
  }

  // Follows the track from one border to the other.
  CGEMIT_NOINLINE Mask step_by_step(const WireLayer& layer, const Point& start, const CellBorders<T>& borders,
                                    const Mask& who, CellRange<T, Point>& range) {
    T arc(0.0);
    Point from = start, to = range.at_wires;
    const Mask enters = motion_.to_cylinder(from, borders.inner, arc, true, who);
    left_ = left_ | (who & motion_.left());
    if (!any(enters)) return enters;
    motion_.look(to);
    const Mask leaves = motion_.to_cylinder(to, borders.outer, arc, true, enters);
    if (const Mask stays = enters & !leaves; any(stays)) {
      const T ahead = arc_to_apex(to);
      advance(to, select(stays & (ahead * abs(to.w) < pi), ahead, T(0.0)));
    }
    const T first = cell_coordinate(layer, atan2(from.y, from.x), from.z);
    const T last = first + cells_between(layer, from, to);
    const T low = nearest_cell(smaller(first, last)), high = nearest_cell(larger(first, last));
    range.first = select(enters, low, range.first);
    range.last = select(enters, smaller(high, low + most_cells), range.last);
    return enters;
  }

  // Number of cells that the azimuth relative to the wires crosses from one point to another.
  static T cells_between(const WireLayer& layer, const HelixPointOf<T>& a, const HelixPointOf<T>& b) {
    const T cross = a.x * b.y - a.y * b.x, dot = a.x * b.x + a.y * b.y, ratio = cross / dot;
    const T turn =
        choose(dot > 0.0, [&] { return ratio * atan_over(ratio); }, [&] { return atan2(cross, dot); });
    const T twist = wire_azimuth(layer, b.z) - wire_azimuth(layer, a.z);
    return (turn - twist) * layer.per_radian;
  }

  const std::vector<WireLayer>& wires_;
  Motion& motion_;
  Mask left_{false};
  T last_x_{0.0}, last_y_{0.0}, azimuth_{0.0};
};

}  // namespace cgemit

// Which drift cells of a layer tracks pass, from their slope at the wires: one track, or one per lane.
#pragma once

#include <cmath>

#include "detector/wires.hpp"
#include "motion/helix.hpp"

namespace cgemit {

inline constexpr int most_cells = 64;  // a particle that runs along a layer fires no more
inline constexpr int many_cells = 1 << 20;
inline int nearest_cell(double c) { return static_cast<int>(c + (many_cells + 0.5)) - many_cells; }
template <class T>
T nearest_cell(const T& c) {
  return nearest(c);
}

// Radial borders of a layer's cells, midway to the neighbouring layers at the track's z.
template <class T>
struct CellBorders {
  T inner, outer;

  CellBorders(const std::vector<WireLayer>& wires, std::size_t index, const T& z) {
    const T here = wire_radius(wires[index], z);
    const T below = index > 0 ? wire_radius(wires[index - 1], z) : T(-HUGE_VAL);
    const T above = index + 1 < wires.size() ? wire_radius(wires[index + 1], z) : T(HUGE_VAL);
    T half_in = 0.5 * (here - below), half_out = 0.5 * (above - here);
    if (index == 0) half_in = smaller(half_out, pi * here / wires[index].cells);
    if (index + 1 == wires.size()) half_out = smaller(half_in, pi * here / wires[index].cells);
    inner = here - half_in;
    outer = here + half_out;
  }
};

// Asked layer by layer on the way out.
template <class T>
class CellsAtOnce {
 public:
  // Cells from first to last, as `nearest_cell` has them; false where the bend of the track could make a
  // difference. `middle`: the track at the radius of the wires; of the lanes `who`.
  template <class Number>
  mask_of<T> find(const WireLayer& layer, const CellBorders<T>& borders, const HelixPointOf<T>& middle,
                  const mask_of<T>& who, Number& first, Number& last) {
    const T p = middle.outward(), radius = middle.radius(), per_p = 1.0 / p, per_radius = 1.0 / radius;
    const T tan_a = middle.sideways() * per_p, per_cos = radius * per_p;
    const T twist_tanl = layer.twist_per_z * middle.tanl;
    const T at = cell_coordinate(layer, azimuth_of(middle, who), middle.z);
    const T slope = (tan_a * per_radius - twist_tanl * per_cos) * layer.per_radian;
    const T height = larger(radius - borders.inner, borders.outer - radius), w = abs(middle.w);
    const T bend = (w + 2.0 * abs(tan_a) * per_radius) * per_cos * per_cos * per_cos * per_radius +
                   abs(twist_tanl) * (w * per_cos + std::abs(layer.twist_per_z)) * per_cos;
    const T unsure = 1e-9 + bend * height * height * layer.per_radian;
    const T one = at + (borders.inner - radius) * slope, other = at + (borders.outer - radius) * slope;
    const T low = smaller(one, other), high = larger(one, other);
    const mask_of<T> few = (p > 0.0) & (abs(low) < many_cells) & (high - low < most_cells);
    if (!any(few)) return few;
    first = nearest_cell(low);
    last = nearest_cell(high);
    return few & (0.5 - abs(low - T(first)) > unsure) & (0.5 - abs(high - T(last)) > unsure);
  }

 private:
  // Counted on from the last point that was asked for: between wire layers the turn is small.
  T azimuth_of(const HelixPointOf<T>& at, const mask_of<T>& who) {
    const T cross = last_x_ * at.y - last_y_ * at.x, dot = last_x_ * at.x + last_y_ * at.y;
    const mask_of<T> ahead = (dot > 0.0) & (abs(cross) < dot);
    const auto counted = [&] {
      const T turn = cross / dot;
      return azimuth_ + turn * atan_over(turn);
    };
    azimuth_ = select(who, choose(ahead | !who, counted, [&] { return atan2(at.y, at.x); }), azimuth_);
    last_x_ = select(who, at.x, last_x_);
    last_y_ = select(who, at.y, last_y_);
    return azimuth_;
  }

  T last_x_{0.0}, last_y_{0.0}, azimuth_{0.0};
};

}  // namespace cgemit

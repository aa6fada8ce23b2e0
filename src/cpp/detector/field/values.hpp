// Values and slopes of the field, for one point or one in each lane.
#pragma once

#include <array>
#include <bit>
#include <cstring>
#include <numbers>

#include "common/lanes/integers.hpp"
#include "common/lanes/math.hpp"
#include "detector/field/field.hpp"

namespace cgemit {

namespace field_values {

// The four B-splines that are not zero at a point, and their derivatives.
template <class T>
struct SplineWeights {
  std::array<std::size_t, lanes_of<T>> first;  // coefficient of the first one
  std::array<T, 4> value, slope;

  SplineWeights(const GridAxis& axis, const T& at) {
    const double last_cell = axis.points - 2, per_step = 1 / axis.step;
    const T position = (at - axis.first) * per_step;
    // The cell that contains the point or, outside the grid, the nearest one.
    const T cell = nearest(select(position > 0.5, smaller(position - 0.5, last_cell), T(0.0)));
    if constexpr (lanes_of<T> == 1)
      first = {static_cast<std::size_t>(cell)};
    else
      first = std::bit_cast<decltype(first)>(whole(cell));
    const T t = position - cell, s = 1.0 - t, t2 = t * t, s2 = s * s;
    value = {s * s2 * (1.0 / 6), (0.5 * t - 1.0) * t2 + 2.0 / 3, (0.5 * s - 1.0) * s2 + 2.0 / 3,
             t * t2 * (1.0 / 6)};
    slope = {-0.5 * per_step * s2, per_step * (1.5 * t - 2.0) * t, -per_step * (1.5 * s - 2.0) * s,
             0.5 * per_step * t2};
  }
};

// Coefficients adjacent in memory; the compiler divides them into registers.
template <int n>
struct Run {
  std::array<double, n> v{};

  void add(double weight, const double* c) {
    for (std::size_t k = 0; k < n; ++k) v[k] += weight * c[k];
  }
};

// Br, Bz and their derivatives by r and z.
template <class T>
struct Meridian {
  T br, bz, br_r, br_z, bz_r, bz_z;
};

template <class T>
Meridian<T> harmonic(const FieldMap& map, const T& r, const T& z) {
  const T r2 = r * r, z2 = z * z;
  const double b = map.b, q = map.q, scale = map.bz;
  const T br_r = scale * z * (b + q * (4.5 * r2 - 2.0 * z2)),
          by_z = scale * r * (b + q * (1.5 * r2 - 6.0 * z2));
  return {scale * z * r * (b + q * (1.5 * r2 - 2.0 * z2)),
          scale * (1.0 - b * (z2 - 0.5 * r2) + q * (z2 * (z2 - 3.0 * r2) + 0.375 * r2 * r2)),
          br_r,
          by_z,
          by_z,
          scale * z * (-2 * b + q * (4.0 * z2 - 6.0 * r2))};
}

template <class T>
Meridian<T> on_grid(const FieldMap& map, const T& r, const T& z) {
  constexpr std::size_t width = lanes_of<T>;
  const SplineWeights<T> in_r(map.axes[0], r), in_z(map.axes[1], z);
  const auto row = static_cast<std::size_t>(map.axes[1].points + 2);
  // Along r lane by lane, in the memory order of the coefficients: Br and Bz of four B-splines in z.
  std::array<Run<8>, width> value, slope;
  for (std::size_t k = 0; k < width; ++k) {
    const double* c = &map.coefficients[2 * (in_r.first[k] * row + in_z.first[k])];
    const int i = static_cast<int>(k);
    Run<8> values, slopes;
    for (std::size_t m = 0; m < 4; ++m, c += 2 * row) {
      values.add(lane(in_r.value[m], i), c);
      slopes.add(lane(in_r.slope[m], i), c);
    }
    value[k] = values;
    slope[k] = slopes;
  }
  const auto column = [](const std::array<Run<8>, width>& runs, std::size_t m) {
    return gathered<T>([&](int k) { return runs[static_cast<std::size_t>(k)].v[m]; });
  };
  Meridian<T> sum{T(0.0), T(0.0), T(0.0), T(0.0), T(0.0), T(0.0)};
  for (std::size_t m = 0; m < 4; ++m) {
    const T br = column(value, 2 * m), bz = column(value, 2 * m + 1);
    sum.br += in_z.value[m] * br;
    sum.bz += in_z.value[m] * bz;
    sum.br_r += in_z.value[m] * column(slope, 2 * m);
    sum.bz_r += in_z.value[m] * column(slope, 2 * m + 1);
    sum.br_z += in_z.slope[m] * br;
    sum.bz_z += in_z.slope[m] * bz;
  }
  return sum;
}

template <class T>
FieldValue<T> around_axis(const FieldMap& map, const Vec3<T>& x) {
  constexpr double on_axis = 1e-3;  // mm; closer to the beam line Br/r is the slope of Br
  const T r = sqrt(x.x * x.x + x.y * x.y);
  const Meridian<T> m = map.kind == FieldKind::harmonic ? harmonic(map, r, x.z) : on_grid(map, r, x.z);
  const mask_of<T> beside = r > on_axis;
  const T per_r = select(beside, 1.0 / r, T(0.0)), ratio = select(beside, m.br * per_r, m.br_r);  // Br/r
  const T ex = x.x * per_r, ey = x.y * per_r, excess = m.br_r - ratio, mixed = ex * ey * excess;
  return {{ratio * x.x, ratio * x.y, m.bz},
          {{ratio + ex * ex * excess, mixed, ex * m.br_z},
           {mixed, ratio + ey * ey * excess, ey * m.br_z},
           {ex * m.bz_r, ey * m.bz_r, m.bz_z}}};
}

template <class T>
FieldValue<T> in_box(const FieldMap& map, const Vec3<T>& x) {
  constexpr std::size_t width = lanes_of<T>;
  const SplineWeights<T> in_x(map.axes[0], x.x), in_y(map.axes[1], x.y), in_z(map.axes[2], x.z);
  const auto column = static_cast<std::size_t>(map.axes[2].points + 2),
             plane = column * static_cast<std::size_t>(map.axes[1].points + 2);
  // Lane by lane, in the memory order of the coefficients: the three components of four B-splines in z.
  std::array<Run<12>, width> value, by_x, by_y;
  for (std::size_t k = 0; k < width; ++k) {
    const double* c = &map.coefficients[3 * (in_x.first[k] * plane + in_y.first[k] * column + in_z.first[k])];
    const int i = static_cast<int>(k);
    for (std::size_t m = 0; m < 4; ++m, c += 3 * plane) {
      Run<12> along_y, slope_y;
      for (std::size_t n = 0; n < 4; ++n) {
        along_y.add(lane(in_y.value[n], i), c + 3 * n * column);
        slope_y.add(lane(in_y.slope[n], i), c + 3 * n * column);
      }
      value[k].add(lane(in_x.value[m], i), along_y.v.data());
      by_x[k].add(lane(in_x.slope[m], i), along_y.v.data());
      by_y[k].add(lane(in_x.value[m], i), slope_y.v.data());
    }
  }
  const auto along_z = [](const std::array<T, 4>& weights, const std::array<Run<12>, width>& runs,
                          std::size_t component) {
    T sum(0.0);
    for (std::size_t m = 0; m < 4; ++m)
      sum += weights[m] *
             gathered<T>([&](int k) { return runs[static_cast<std::size_t>(k)].v[3 * m + component]; });
    return sum;
  };
  const auto slopes = [&](std::size_t component) {
    return Vec3<T>{along_z(in_z.value, by_x, component), along_z(in_z.value, by_y, component),
                   along_z(in_z.slope, value, component)};
  };
  return {{along_z(in_z.value, value, 0), along_z(in_z.value, value, 1), along_z(in_z.value, value, 2)},
          {slopes(0), slopes(1), slopes(2)}};
}

// The splines in r, phi, z, with slopes turned to x and y.
template <class T>
FieldValue<T> around_turn(const FieldMap& map, const Vec3<T>& x) {
  constexpr double on_axis = 1e-3,
                   whole_turn = 2 * std::numbers::pi;  // mm; closer to the beam line: as there
  const T distance = sqrt(x.x * x.x + x.y * x.y);
  const mask_of<T> beside = distance > on_axis;
  const T r = select(beside, distance, T(on_axis));
  const T across = select(beside, x.x, T(on_axis)), up = select(beside, x.y, T(0.0));
  const T azimuth = atan2(up, across);
  const T phi = select(azimuth < map.axes[1].first, azimuth + whole_turn, azimuth);
  const FieldValue<T> on_splines = in_box(map, Vec3<T>{r, phi, x.z});
  const T cosine = across / r, sine = up / r;
  const auto turned = [&](const Vec3<T>& slope) {
    const T around = slope.y / r;
    return Vec3<T>{cosine * slope.x - sine * around, sine * slope.x + cosine * around, slope.z};
  };
  const Mat3<T>& slope = on_splines.slope;
  return {on_splines.b, {turned(slope.x), turned(slope.y), turned(slope.z)}};
}

}  // namespace field_values

template <class T>
FieldValue<T> FieldMap::at(const Vec3<T>& x) const {
  if (kind == FieldKind::box) return field_values::in_box(*this, x);
  if (kind == FieldKind::polar) return field_values::around_turn(*this, x);
  if (kind != FieldKind::uniform) return field_values::around_axis(*this, x);
  const T zero(0.0);
  const Vec3<T> none{zero, zero, zero};
  return {{zero, zero, T(bz)}, {none, none, none}};
}

}  // namespace cgemit

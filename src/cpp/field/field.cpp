#include "field/field.hpp"

#include <algorithm>

namespace cgemit {

namespace {

constexpr double on_axis = 1e-3;  // mm; nearer to the beam line Br/r is the slope of Br

// The four B-splines that are not zero at a point, and their derivatives.
struct Weights {
  std::size_t first;  // coefficient of the first one
  std::array<double, 4> value, slope;
};

Weights weights(const GridAxis& axis, double at) {
  const double position = (at - axis.first) / axis.step, last_cell = axis.points - 2;
  const double cell = position > 0 ? std::floor(std::min(position, last_cell)) : 0.0;
  const double t = position - cell, s = 1 - t, per_step = 1 / axis.step;
  return {static_cast<std::size_t>(cell),
          {s * s * s / 6, (3 * t * t * t - 6 * t * t + 4) / 6, (3 * s * s * s - 6 * s * s + 4) / 6,
           t * t * t / 6},
          {-0.5 * s * s * per_step, (1.5 * t - 2) * t * per_step, -(1.5 * s - 2) * s * per_step,
           0.5 * t * t * per_step}};
}

// Br, Bz and their derivatives by r and z.
struct Meridian {
  double br, bz, br_r, br_z, bz_r, bz_z;
};

Meridian harmonic(const FieldMap& map, double r, double z) {
  const double r2 = r * r, z2 = z * z, b = map.b, q = map.q, scale = map.bz;
  return {scale * z * r * (b + q * (1.5 * r2 - 2 * z2)),
          scale * (1 - b * (z2 - 0.5 * r2) + q * (z2 * (z2 - 3 * r2) + 0.375 * r2 * r2)),
          scale * z * (b + q * (4.5 * r2 - 2 * z2)),
          scale * r * (b + q * (1.5 * r2 - 6 * z2)),
          scale * r * (b + q * (1.5 * r2 - 6 * z2)),
          scale * z * (-2 * b + q * (4 * z2 - 6 * r2))};
}

template <bool slopes>
Meridian on_grid(const FieldMap& map, double r, double z) {
  const Weights in_r = weights(map.axes[0], r), in_z = weights(map.axes[1], z);
  const auto row = static_cast<std::size_t>(map.axes[1].points + 2);
  Meridian sum{};
  for (std::size_t i = 0; i < 4; ++i) {
    const double* c = &map.coefficients[2 * ((in_r.first + i) * row + in_z.first)];
    double br = 0, bz = 0, br_z = 0, bz_z = 0;
    for (std::size_t k = 0; k < 4; ++k) {
      br += in_z.value[k] * c[2 * k];
      bz += in_z.value[k] * c[2 * k + 1];
      if constexpr (slopes) {
        br_z += in_z.slope[k] * c[2 * k];
        bz_z += in_z.slope[k] * c[2 * k + 1];
      }
    }
    sum.br += in_r.value[i] * br;
    sum.bz += in_r.value[i] * bz;
    sum.br_r += in_r.slope[i] * br;  // Br/r on the axis, too
    if constexpr (!slopes) continue;
    sum.bz_r += in_r.slope[i] * bz;
    sum.br_z += in_r.value[i] * br_z;
    sum.bz_z += in_r.value[i] * bz_z;
  }
  return sum;
}

template <bool slopes>
FieldVector around_axis(const FieldMap& map, double x, double y, double z, FieldGradient* gradient) {
  const double r = std::sqrt(x * x + y * y);
  const Meridian m = map.kind == FieldKind::harmonic ? harmonic(map, r, z) : on_grid<slopes>(map, r, z);
  const bool beside = r > on_axis;
  const double per_r = beside ? 1 / r : 0, ratio = beside ? m.br * per_r : m.br_r;  // Br/r
  if constexpr (slopes) {
    const double ex = x * per_r, ey = y * per_r, excess = m.br_r - ratio;
    *gradient = {{{ratio + ex * ex * excess, ex * ey * excess, ex * m.br_z},
                  {ex * ey * excess, ratio + ey * ey * excess, ey * m.br_z},
                  {ex * m.bz_r, ey * m.bz_r, m.bz_z}}};
  }
  return {ratio * x, ratio * y, m.bz};
}

template <bool slopes>
FieldVector in_box(const FieldMap& map, double x, double y, double z, FieldGradient* gradient) {
  const Weights wx = weights(map.axes[0], x), wy = weights(map.axes[1], y), wz = weights(map.axes[2], z);
  const auto column = static_cast<std::size_t>(map.axes[2].points + 2),
             plane = column * static_cast<std::size_t>(map.axes[1].points + 2);
  FieldVector b{};
  FieldGradient by{};
  for (std::size_t i = 0; i < 4; ++i) {
    for (std::size_t k = 0; k < 4; ++k) {
      const double* c = &map.coefficients[3 * ((wx.first + i) * plane + (wy.first + k) * column + wz.first)];
      for (std::size_t m = 0; m < 3; ++m) {
        const double value =
            wz.value[0] * c[m] + wz.value[1] * c[3 + m] + wz.value[2] * c[6 + m] + wz.value[3] * c[9 + m];
        b[m] += wx.value[i] * wy.value[k] * value;
        if constexpr (!slopes) continue;
        const double slope =
            wz.slope[0] * c[m] + wz.slope[1] * c[3 + m] + wz.slope[2] * c[6 + m] + wz.slope[3] * c[9 + m];
        by[m][0] += wx.slope[i] * wy.value[k] * value;
        by[m][1] += wx.value[i] * wy.slope[k] * value;
        by[m][2] += wx.value[i] * wy.value[k] * slope;
      }
    }
  }
  if constexpr (slopes) *gradient = by;
  return b;
}

template <bool slopes>
FieldVector evaluate(const FieldMap& map, double x, double y, double z, FieldGradient* gradient) {
  if (map.kind == FieldKind::box) return in_box<slopes>(map, x, y, z, gradient);
  if (map.kind != FieldKind::uniform) return around_axis<slopes>(map, x, y, z, gradient);
  if constexpr (slopes) *gradient = {};
  return {0, 0, map.bz};
}

}  // namespace

bool FieldMap::holds(double x, double y, double z) const {
  if (kind == FieldKind::box) return axes[0].holds(x) && axes[1].holds(y) && axes[2].holds(z);
  if (kind == FieldKind::cylinder) return axes[0].holds(std::sqrt(x * x + y * y)) && axes[1].holds(z);
  return true;
}

FieldVector FieldMap::at(double x, double y, double z) const {
  return evaluate<false>(*this, x, y, z, nullptr);
}

FieldVector FieldMap::at(double x, double y, double z, FieldGradient& gradient) const {
  return evaluate<true>(*this, x, y, z, &gradient);
}

}  // namespace cgemit

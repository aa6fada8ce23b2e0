// The magnetic field at a point: uniform, harmonic, or interpolated on a grid. T, mm.
#pragma once

#include <vector>

#include "common/lanes/vec3.hpp"

namespace cgemit {

enum class FieldKind { uniform, harmonic, cylinder, box, polar };

// One axis of a grid: equidistant points, with one additional coefficient beyond either end.
struct GridAxis {
  double first, step;  // mm; rad
  int points;

  double last() const { return first + step * (points - 1); }
  template <class T>
  mask_of<T> holds(const T& value) const {
    return (value >= first) & (value <= last());
  }
};

// The field at one point and its gradient.
template <class T>
struct FieldValue {
  Vec3<T> b;      // T
  Mat3<T> slope;  // d B_i / d x_j, T/mm

  friend FieldValue select(const mask_of<T>& m, const FieldValue& one, const FieldValue& other) {
    return {select<T>(m, one.b, other.b), select<T>(m, one.slope, other.slope)};
  }
};

// Between the points of a grid the field is a cubic spline in each direction, twice continuously
// differentiable: sums of cubic B-splines (C. de Boor, A Practical Guide to Splines, 1978, chapter IX) with
// coefficients from `cgemit.detector.field`.
struct FieldMap {
  FieldKind kind;
  double bz;  // T, at the origin
  // Bz = bz [1 - b (z^2 - r^2/2) + q (z^4 - 3 z^2 r^2 + 3 r^4/8)], and the Br that satisfies Maxwell's
  // equations with it.
  double b, q;  // mm^-2, mm^-4
  // r, z with Br, Bz ("cylinder"), x, y, z ("box") or r, phi, z ("polar") with Bx, By, Bz: the last axis runs
  // fastest, then the component. phi begins at or above -pi, and its last point is the first one after a
  // whole turn. A harmonic field has no coefficients; axes in r and z, if there are any, say where it holds.
  std::vector<GridAxis> axes;
  std::vector<double> coefficients;
  double tolerance;  // mm, error allowed in one step of a track

  bool is_uniform() const { return kind == FieldKind::uniform; }
  // Whether points lie within the axes. Beyond them the field is unknown, and `at` continues the outermost
  // polynomials.
  template <class T>
  mask_of<T> holds(const Vec3<T>& x) const;
  // Per lane; `detector/field/values.hpp`.
  template <class T>
  FieldValue<T> at(const Vec3<T>& x) const;
};

inline FieldMap uniform_field(double bz) { return {FieldKind::uniform, bz, 0, 0, {}, {}, 0}; }

template <class T>
mask_of<T> FieldMap::holds(const Vec3<T>& x) const {
  if (kind == FieldKind::box) return axes[0].holds(x.x) & axes[1].holds(x.y) & axes[2].holds(x.z);
  if (axes.empty()) return mask_of<T>(true);
  const T r2 = x.x * x.x + x.y * x.y;
  const double first = axes[0].first, last = axes[0].last();
  return (r2 >= first * first) & (r2 <= last * last) & axes.back().holds(x.z);
}

}  // namespace cgemit

// The magnetic field at a point: uniform, harmonic, or interpolated on a grid. T, mm.
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

namespace cgemit {

using FieldVector = std::array<double, 3>;                   // Bx By Bz, T
using FieldGradient = std::array<std::array<double, 3>, 3>;  // d B_i / d x_j, T/mm

enum class FieldKind { uniform, harmonic, cylinder, box };

// One axis of a grid: equidistant points, with one coefficient more beyond either end.
struct GridAxis {
  double first, step;  // mm
  int points;

  double last() const { return first + step * (points - 1); }
  bool holds(double value) const { return value >= first && value <= last(); }
};

// Between the points of a grid the field is a cubic spline in each direction, twice continuously
// differentiable: sums of cubic B-splines (C. de Boor, A Practical Guide to Splines, 1978, chapter IX) whose
// coefficients `cgemit.detector.field.grid` works out.
struct FieldMap {
  FieldKind kind;
  double bz;  // T, at the origin
  // Bz = bz [1 - b (z^2 - r^2/2) + q (z^4 - 3 z^2 r^2 + 3 r^4/8)], and the Br that goes with it.
  double b, q;  // mm^-2, mm^-4
  // r, z with Br, Bz ("cylinder"), or x, y, z with Bx, By, Bz ("box"): the last axis runs fastest, then the
  // component.
  std::vector<GridAxis> axes;
  std::vector<double> coefficients;
  double tolerance;  // mm, error allowed to one step of a track

  bool is_uniform() const { return kind == FieldKind::uniform; }
  // Beyond the grid there is no field to speak of; `at` goes on with its outermost polynomials.
  bool holds(double x, double y, double z) const;
  FieldVector at(double x, double y, double z) const;
  FieldVector at(double x, double y, double z, FieldGradient& gradient) const;
};

inline FieldMap uniform_field(double bz) { return {FieldKind::uniform, bz, 0, 0, {}, {}, 0}; }

}  // namespace cgemit

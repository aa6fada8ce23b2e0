// The strips that a straight segment on the unrolled readout touches: exact geometry, no sampling.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>

#include "detector/strip_plane.hpp"

namespace cgemit {

struct Point {
  double x, y, z;  // mm
};

// The part of a segment that lies on one sheet, in local coordinates.
struct SheetPiece {
  int sheet;
  double x1, z1, x2, z2;  // mm, 0 <= x <= sheet_width(), z between the ends
};

// A segment spans at most half a turn: only its first sheet can hold its end, too.
struct Pieces {
  int n = 0;
  std::array<SheetPiece, most_sheets + 1> list;
};

// Strips first to last, both included; none if last < first.
struct StripRange {
  int first, last;
  int count() const { return std::max(0, last - first + 1); }
};

// Narrows [t0, t1] to the part with low <= a + t d <= high.
inline void narrow(double a, double d, double low, double high, double& t0, double& t1) {
  if (d == 0) {
    if (a < low || a > high) t1 = t0;
    return;
  }
  const double at_low = (low - a) / d, at_high = (high - a) / d;
  t0 = std::max(t0, std::min(at_low, at_high));
  t1 = std::min(t1, std::max(at_low, at_high));
}

// Clips the segment from (x, z) over (dx, dz) to the sheet and appends the remaining part.
inline void clip(const MeasuringLayer& layer, int sheet, double x, double z, double dx, double dz,
                 Pieces& pieces) {
  const double width = layer.sheet_width();
  if (dx == 0 && x >= width) return;  // along the border: it belongs to the neighbour
  double t0 = 0, t1 = 1;
  narrow(x, dx, 0, width, t0, t1);
  narrow(z, dz, layer.ends.low, layer.ends.high, t0, t1);
  if (!(t0 < t1)) return;  // off the sheet, or it only touches the edge
  const auto inside_x = [&](double t) { return std::clamp(x + t * dx, 0.0, width); };
  const auto inside_z = [&](double t) { return std::clamp(z + t * dz, layer.ends.low, layer.ends.high); };
  pieces.list[static_cast<std::size_t>(pieces.n++)] = {sheet, inside_x(t0), inside_z(t0), inside_x(t1),
                                                       inside_z(t1)};
}

// Projects entry and exit point to the readout, by the layer's Lorentz shift in X and at unchanged z, and
// unrolls the straight line between them, along the shorter direction in phi. Gives pieces on every sheet
// that it touches (two at a seam or a sheet's edge).
inline Pieces unroll(const MeasuringLayer& layer, const Point& entry, const Point& exit) {
  const double from = std::atan2(entry.y, entry.x);
  const double dx = layer.r_readout * turn_between(entry.x, entry.y, exit.x, exit.y);
  const double phi = from + layer.lorentz_shift / layer.r_readout;
  const double dz = exit.z - entry.z;
  const double whole_turn = 2 * pi * layer.r_readout;
  Pieces pieces;
  for (int sheet = 0; sheet < layer.sheets; ++sheet) {
    const double x = local_x(layer, sheet, phi);
    clip(layer, sheet, x, entry.z, dx, dz, pieces);
    if (x + dx >= whole_turn) clip(layer, sheet, x - whole_turn, entry.z, dx, dz, pieces);
    if (x + dx < 0) clip(layer, sheet, x + whole_turn, entry.z, dx, dz, pieces);
  }
  return pieces;
}

// The strips, out of `strips`, between two positions counted in strips.
inline StripRange strips_between(double a, double b, int strips) {
  const auto strip = [](double position) { return static_cast<int>(std::floor(position)); };
  return {std::max(strip(std::min(a, b)), 0), std::min(strip(std::max(a, b)), strips - 1)};
}

// X strips of a piece. A piece lies on the sheet: its far edge belongs to the last strip.
inline StripRange x_strips(const MeasuringLayer& layer, const SheetPiece& piece) {
  StripRange range =
      strips_between(strips_of_x(layer, piece.x1), strips_of_x(layer, piece.x2), layer.strips_x);
  range.first = std::min(range.first, range.last);
  return range;
}

// V strips of a piece; none in the corners of the sheet before the first and beyond the last V strip.
inline StripRange v_strips(const MeasuringLayer& layer, const SheetPiece& piece) {
  const double v1 = std::max(0.0, local_v(layer, piece.x1, piece.z1));  // rounding at the corner where V = 0
  const double v2 = std::max(0.0, local_v(layer, piece.x2, piece.z2));
  return strips_between(strips_of_v(layer, v1), strips_of_v(layer, v2), layer.strips_v);
}

}  // namespace cgemit

#include "matter/foil.hpp"

#include <algorithm>
#include <cmath>

namespace cgemit {

namespace {

constexpr double row = 0.86602540378443864676;  // distance of rows over the pitch, sqrt(3)/2
constexpr double most_pieces = 200;

double rounded(double x) { return static_cast<int>(x + std::copysign(0.5, x)); }

// Makes a point relative to the nearest hole; holes are at (i + j/2, j sqrt(3)/2) pitches. Rounding i, j and
// -i-j and then correcting the one with the largest error gives the hexagon that contains the point.
void from_nearest_hole(double pitch, double& u, double& v) {
  const double j = v / (row * pitch), i = u / pitch - 0.5 * j, k = -i - j;
  double ni = rounded(i), nj = rounded(j);
  const double nk = rounded(k);
  const double di = std::abs(ni - i), dj = std::abs(nj - j), dk = std::abs(nk - k);
  if (di > dj && di > dk) {
    ni = -nj - nk;
  } else if (dj > dk) {
    nj = -ni - nk;
  }
  u -= (ni + 0.5 * nj) * pitch;
  v -= nj * row * pitch;
}

// Length of the part of w, from 0 to `step`, in which (u + slope_u w, v + slope_v w) lies in a circle of
// radius r + grow w about 0: a w^2 + 2 b w + c < 0.
double length_in_hole(double u, double v, double slope_u, double slope_v, double r, double grow,
                      double step) {
  const double a = slope_u * slope_u + slope_v * slope_v - grow * grow;
  const double b = u * slope_u + v * slope_v - r * grow;
  const double c = u * u + v * v - r * r;
  const double discriminant = b * b - a * c;
  if (!(discriminant > 0)) return c < 0 ? step : 0;
  const double q = -(b + std::copysign(std::sqrt(discriminant), b));
  const auto [low, high] = std::minmax({q / a, c / q});  // a = 0: one is infinite
  const double between = std::max(std::min(high, step) - std::max(low, 0.0), 0.0);
  return a < 0 ? step - between : between;
}

// Mean over the lattice of the length inside holes, between `from` and `to` on one side of the middle.
double mean_length_in_holes(const Holes& holes, double r_from, double r_to, double length) {
  const double mean_r2 = (r_from * r_from + r_from * r_to + r_to * r_to) / 3;
  return pi * mean_r2 / (row * holes.pitch * holes.pitch) * length;
}

// Length of w inside holes, with `from` and `to` on the same side of the foil's middle.
double length_in_holes(const Holes& holes, const FoilLine& line, double from, double to) {
  const double r_from = holes.waist + holes.widening * std::abs(from);
  const double r_to = holes.waist + holes.widening * std::abs(to);
  // A piece shorter than the bridge between two holes can cross only the hole nearest to its middle: any
  // other centre is at least half a pitch from there.
  const double run = std::sqrt(line.slope_u * line.slope_u + line.slope_v * line.slope_v) * (to - from);
  const double bridge = holes.pitch - 2 * std::max(r_from, r_to);
  if (run > most_pieces * bridge) return mean_length_in_holes(holes, r_from, r_to, to - from);
  const int n = 1 + static_cast<int>(run / bridge);
  const double step = (to - from) / n, grow = (r_to - r_from) / (to - from);
  double sum = 0;
  for (int i = 0; i < n; ++i) {
    const double begin = from + i * step, middle = begin + 0.5 * step;
    double u = line.u + line.slope_u * middle, v = line.v + line.slope_v * middle;
    from_nearest_hole(holes.pitch, u, v);
    u -= line.slope_u * 0.5 * step;
    v -= line.slope_v * 0.5 * step;
    sum += length_in_hole(u, v, line.slope_u, line.slope_v, r_from + grow * i * step, grow, step);
  }
  return sum;
}

}  // namespace

double solid_fraction(const Holes& holes, const FoilLine& line) {
  const bool through_middle = holes.begin < 0 && holes.end > 0;
  const double open = through_middle ? length_in_holes(holes, line, holes.begin, 0) +
                                           length_in_holes(holes, line, 0, holes.end)
                                     : length_in_holes(holes, line, holes.begin, holes.end);
  return std::clamp(1 - open / (holes.end - holes.begin), 0.0, 1.0);
}

double fraction_beside_holes(const Slab& slab, const HelixPoint& point, const Stream& stream) {
  const Block words = stream.block(Purpose::foil, static_cast<std::uint32_t>(slab.holes.foil));
  const double i = open_unit(words[0]), j = open_unit(words[1]), pitch = slab.holes.pitch;
  // A track that grazes the slab crosses at most its chord, as in `path_factor`.
  const double along = point.outward(),
               outward = std::copysign(std::max(std::abs(along), slab.least_outward), along);
  return solid_fraction(slab.holes, {(i + 0.5 * j) * pitch, j * row * pitch, point.sideways() / outward,
                                     point.tanl * point.radius() / outward});
}

}  // namespace cgemit

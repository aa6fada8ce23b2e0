// What a track crosses in all, and how much of a slab it sees.
//
// Core widths of scattering and straggling are not additive: cut a slab in two and the sum differs. Both are
// therefore taken once for the whole track and shared out in proportion, so that nothing depends on how
// matter is cut.
#pragma once

#include <algorithm>
#include <cmath>

#include "detector/detector.hpp"
#include "matter/kinematics.hpp"

namespace cgemit {

// Below this kinetic energy a particle counts as stopped.
inline constexpr double least_kinetic = 0.1 * MeV;

// Sums over all slabs, along the track.
template <class T>
struct TrackMatterOf {
  T x0{0.0};      // radiation lengths
  T xi{0.0};      // GeV, Landau's xi times beta^2
  T chi_c2{0.0};  // GeV^2, chi_c^2 times (p beta)^2
  T log_xi{0.0}, log_chi_c2{0.0};
  LossCuts loss{};
};
using TrackMatter = TrackMatterOf<double>;

// Matter of the detector along a straight line from the origin with this slope.
template <class T>
TrackMatterOf<T> total_matter(const Detector& detector, T tanl) {
  TrackMatterOf<T> total;
  mask_of<T> inside(true);
  for (const Slab& slab : detector.slabs) {
    const mask_of<T> met = inside & (abs(tanl) * slab.radius <= slab.half_length);
    total.x0 += select(met, T(slab.x0), 0.0);
    total.xi += select(met, T(slab.xi), 0.0);
    total.chi_c2 += select(met, T(slab.chi_c2), 0.0);
    if (slab.ends) inside = met;
  }
  const T path = sqrt(1.0 + tanl * tanl);
  total.x0 *= path;
  total.xi *= path;
  total.chi_c2 *= path;
  total.loss = detector.loss;
  // Logarithms of an empty detector exist, too.
  total.log_xi = log(larger(total.xi, 1e-15));
  total.log_chi_c2 = log(larger(total.chi_c2, 1e-15));
  return total;
}

// Factor by which a track sees a slab thicker than at normal incidence: `stretch` = 1/cos(lambda), times
// 1/cos(a), cos(a) = P/r. A grazing track sees at most the chord of the shell.
template <class T>
T path_factor(const Slab& slab, T stretch, T outward) {
  return stretch * slab.radius / larger(outward, slab.least_outward);
}

// Where a slab's table is read.
struct GridPlace {
  std::size_t i;
  double fraction;

  explicit GridPlace(double log_bg) {
    const double position = (log_bg - loss_grid_first) / loss_grid_step;
    const int bin = std::clamp(static_cast<int>(position), 0, loss_points - 2);
    i = static_cast<std::size_t>(bin);
    fraction = position - bin;
  }
  double between(double a, double b) const { return a + fraction * (b - a); }
};

// A column of that table, and its slope, per track.
template <class T>
struct Read {
  T value, slope;
};
template <double SlabPoint::* column, class T>
Read<T> read(const Slab& slab, const T& log_bg) {
  Read<T> out;
  for (int k = 0; k < lanes_of<T>; ++k) {
    const GridPlace place(lane(log_bg, k));
    const double here = slab.table[place.i].*column, next = slab.table[place.i + 1].*column;
    set_lane(out.value, k, place.between(here, next));
    set_lane(out.slope, k, (next - here) / loss_grid_step);
  }
  return out;
}

}  // namespace cgemit

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
struct TrackMatter {
  double x0 = 0;      // radiation lengths
  double xi = 0;      // GeV, Landau's xi times beta^2
  double chi_c2 = 0;  // GeV^2, chi_c^2 times (p beta)^2
  double log_xi = 0, log_chi_c2 = 0;
};

// Matter of the detector along a straight line from the origin with this slope.
TrackMatter total_matter(const Detector& detector, double tanl);

// Factor by which a track sees a slab thicker than at normal incidence: `stretch` = 1/cos(lambda), times
// 1/cos(a), cos(a) = P/r. A grazing track sees at most the chord of the shell.
inline double path_factor(const Slab& slab, double stretch, double outward) {
  return stretch * slab.radius / std::max(outward, slab.least_outward);
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

}  // namespace cgemit

// The total matter along a track, and the path of a track in a slab.
//
// Core widths of scattering and straggling are not additive: the sum changes if a slab is cut in two. The
// core is therefore computed once for all matter that acts on the same parameters and shared out in
// proportion, so that the result does not depend on how matter is cut. All energy losses act on kappa. Of the
// scatters only those between the wires act on kappa, and they contain a few per cent of the matter, so they
// have their own core.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>

#include "common/lanes/integers.hpp"
#include "detector/detector.hpp"
#include "matter/kinematics.hpp"

namespace cgemit {

// Below this kinetic energy a particle counts as stopped.
inline constexpr double least_kinetic = 0.1 * MeV;

// Groups of slabs whose scatters act on the same parameters: the gas and wires of the drift chamber, which
// alone affect kappa, and all other slabs, which affect direction and position at the origin.
inline constexpr std::size_t scattering_groups = 2;
inline std::size_t scattering_group(const Slab& slab) { return slab.ends ? 1 : 0; }

// chi_c^2 times (p beta)^2 of a group of slabs along the track, GeV^2, and its logarithm.
template <class T>
struct ScatteringSumOf {
  T chi_c2{0.0}, log_chi_c2{0.0};
};

// Sums over all slabs, along the track.
template <class T>
struct TrackMatterOf {
  T x0{0.0};                                                       // radiation lengths
  T xi{0.0};                                                       // GeV, Landau's xi times beta^2
  std::array<ScatteringSumOf<T>, scattering_groups> scattering{};  // by `scattering_group`
  LossCuts loss{};
  // A cut of the loss on this track, GeV, its inverse and its logarithm: the logarithms of the cuts elsewhere
  // on the track follow by a series.
  T cut{1.0}, per_cut{1.0}, log_cut{0.0};
};
using TrackMatter = TrackMatterOf<double>;

// Matter of the detector along a straight line from the origin with this tanl.
template <class T>
TrackMatterOf<T> total_matter(const Detector& detector, T tanl) {
  TrackMatterOf<T> total;
  mask_of<T> inside(true);
  for (const Slab& slab : detector.slabs) {
    const mask_of<T> met = inside & (abs(tanl) * slab.radius <= slab.half_length);
    total.x0 += select(met, T(slab.x0), 0.0);
    total.xi += select(met, T(slab.xi), 0.0);
    total.scattering[scattering_group(slab)].chi_c2 += select(met, T(slab.chi_c2), 0.0);
    if (slab.ends) inside = met;
  }
  const T path = sqrt(1.0 + tanl * tanl);
  total.x0 *= path;
  total.xi *= path;
  total.loss = detector.loss;
  for (ScatteringSumOf<T>& sum : total.scattering) {
    sum.chi_c2 *= path;
    sum.log_chi_c2 = log(larger(sum.chi_c2, 1e-15));  // finite for an empty detector, too
  }
  return total;
}

// Path of a track in a slab over the path at normal incidence: `sec_lambda` = 1/cos(lambda), times 1/cos(a),
// cos(a) = P/r. The path of a grazing track is at most the chord of the shell.
template <class T>
T path_factor(const Slab& slab, T sec_lambda, T outward) {
  return sec_lambda * slab.radius / larger(outward, slab.least_outward);
}

// Position on the grid of a slab's table.
struct GridPlace {
  std::size_t i;
  double fraction;

  explicit GridPlace(double log_bg) {
    const double position = (log_bg - loss_grid_first) * loss_grid_per_step;
    const int bin = std::clamp(static_cast<int>(position), 0, loss_points - 2);
    i = static_cast<std::size_t>(bin);
    fraction = position - bin;
  }
  double between(double a, double b) const { return a + fraction * (b - a); }
};

// The same for several tracks.
template <class T>
struct GridPlaces {
  std::array<std::size_t, lanes_of<T>> i;
  T fraction;
  bool together = true;  // whether all lanes are in the same bin

  explicit GridPlaces(const T& log_bg) {
    if constexpr (lanes_of<T> == 1) {
      const GridPlace place(log_bg);
      i = {place.i};
      fraction = place.fraction;
    } else {
      const T position = (log_bg - loss_grid_first) * loss_grid_per_step;
      const T bin = nearest(smaller(larger(position - 0.5, 0.0), loss_points - 2.0));
      fraction = position - bin;
      i = std::bit_cast<decltype(i)>(whole(bin));
      together = all(bin == lane(bin, 0));
    }
  }
};

// A column of that table and its slope, per track.
template <class T>
struct Read {
  T value, slope;
};
template <double SlabPoint::* column, class T>
Read<T> read(const Slab& slab, const GridPlaces<T>& at) {
  T here, next;
  if (at.together) {
    here = slab.table[at.i[0]].*column;
    next = slab.table[at.i[0] + 1].*column;
  } else {
    here = gathered<T>([&](int k) { return slab.table[at.i[static_cast<std::size_t>(k)]].*column; });
    next = gathered<T>([&](int k) { return slab.table[at.i[static_cast<std::size_t>(k)] + 1].*column; });
  }
  return {here + at.fraction * (next - here), (next - here) * loss_grid_per_step};
}
template <double SlabPoint::* column, class T>
Read<T> read(const Slab& slab, const T& log_bg) {
  return read<column>(slab, GridPlaces<T>(log_bg));
}

}  // namespace cgemit

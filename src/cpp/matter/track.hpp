// The total matter along a track, and the path of a track in a slab.
//
// Core widths of scattering and straggling are not additive: the sum changes if a slab is cut in two. The
// core of a slab is therefore that of all matter that acts on the same parameters, so that the result does
// not depend on how matter is cut. `Slab::acting` says which scatters act together. All energy losses act on
// kappa, each slab's with the weight `Slab::unseen`.
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

// Sums over all slabs, along the track.
template <class T>
struct TrackMatterOf {
  T x0{0.0};      // radiation lengths, each slab's times its `unseen`
  T xi{0.0};      // GeV, Landau's xi times beta^2, each slab's times its `unseen`
  T chi_c2{0.0};  // GeV^2, chi_c^2 times (p beta)^2
  LossCuts loss{};
  // A cut of the loss on this track, GeV, its inverse and its logarithm: the logarithms of the cuts elsewhere
  // on the track follow by a series.
  T cut{1.0}, per_cut{1.0}, log_cut{0.0};
  T error{0.0};  // of the momentum without straggling, relative
  T path{1.0};   // over that at normal incidence
};
using TrackMatter = TrackMatterOf<double>;

// Matter of the detector along a straight line from the origin with this tanl.
template <class T>
TrackMatterOf<T> total_matter(const Detector& detector, T tanl) {
  TrackMatterOf<T> total;
  mask_of<T> inside(true), chamber(true);  // as in `motion/reach.hpp`
  for (const Slab& slab : detector.slabs) {
    const T z = tanl * slab.radius;
    mask_of<T> met = inside & slab.ends.hold(z);
    if (slab.filler == Filler::chamber_gas) {
      met = chamber & met;
      if (!slab.reopens) chamber = chamber & (abs(z) < slab.ends.ahead(tanl));
    }
    total.x0 += select(met, T(slab.x0 * slab.unseen), 0.0);
    total.xi += select(met, T(slab.xi * slab.unseen), 0.0);
    total.chi_c2 += select(met, T(slab.chi_c2), 0.0);
    inside = inside & (chamber | slab.slopes_beyond.hold(tanl));
  }
  total.path = sqrt(1.0 + tanl * tanl);
  total.x0 *= total.path;
  total.xi *= total.path;
  total.chi_c2 *= total.path;
  total.loss = detector.loss;
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

// What a cluster's length and the track's incidence say about its position.
//
// A path of projected length w = (m + f) p, p the pitch and 0 <= f < 1, touches m + 1 strips with
// probability 1 - f or m + 2 with probability f; its centre is uniform in (1 - f) p or f p about theirs. A
// delta electron (or another particle) adds k strips on one side with probability delta_strips / k, and the
// centre of all strips is k p / 2 off: the variance is that of the mixture of all that makes as many strips
// as were seen. Where nothing does, the path lies anywhere in the cluster, or was cut off and lies up to
// half of what is missing beside.
#pragma once

#include "fit/fit.hpp"

namespace cgemit {

template <class T>
T delta_adds(T strips, double delta_strips) {
  return select(strips > 0.0, delta_strips / larger(strips, 1.0), select(strips == 0.0, T(1.0), T(0.0)));
}

// Variance in squared pitches of a position that is uniform in an interval and off by half a strip for each
// one added.
template <class T>
T position_variance(T added, T interval, double least_width) {
  const T width = larger(interval, least_width);
  return added * added * 0.25 + width * width * (1.0 / 12);
}

// Variance, mm^2, of the position of a cluster of `size` strips for a path of this extent, mm.
template <class T>
T cluster_variance(T size, T extent, double pitch, const FitSettings& settings) {
  const T length = extent * (1 / pitch), rounded = nearest(length);
  const T whole = select(rounded > length, rounded - 1.0, rounded), part = length - whole;
  const T added = size - 1.0 - whole;
  const T fewer = (1.0 - part) * delta_adds(added, settings.delta_strips),
          more = part * delta_adds(added - 1.0, settings.delta_strips);
  const T both = fewer + more;
  const T mixture = fewer * position_variance<T>(added, 1.0 - part, settings.least_width) +
                    more * position_variance<T>(added - 1.0, part, settings.least_width);
  const T anywhere = larger(abs(size * pitch - extent), pitch);
  const mask_of<T> can_be = both > 0.0;
  return select(can_be, pitch * pitch * mixture / select(can_be, both, T(1.0)),
                anywhere * anywhere * (1.0 / 12));
}

}  // namespace cgemit

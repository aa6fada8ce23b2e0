// Position errors of clusters from their strips, for the clusters table (averaged over a sample of tracks,
// `reconstruction/cluster/size_errors.hpp`) and for the fit (at the incidence of its track).
//
// A path of projected length w = (m + f) p, p the pitch and 0 <= f < 1, touches m + 1 strips with probability
// 1 - f or m + 2 with probability f. Its centre is uniform in an interval of (1 - f) p or f p about the
// centre of the strips. A delta electron (or another particle) adds k strips on one side with probability
// delta_strips / k, which displaces the centre of all strips by k p / 2. The variance is that of the mixture
// of all combinations with the observed number of strips. If there is no such combination, the path either
// lies anywhere in the cluster, or was cut off and lies up to half of the missing length beside it.
#pragma once

#include "common/lanes/math.hpp"
#include "detector/detector.hpp"

namespace cgemit {

// The number of strips that a path touches.
template <class T>
struct Touched {
  T whole;  // m: the path touches m + 1 strips or one more
  T part;   // f
};

template <class T>
Touched<T> touched(T extent, double pitch) {
  const T length = extent * (1 / pitch), rounded = nearest(length);
  const T whole = select(rounded > length, rounded - 1.0, rounded);
  return {whole, length - whole};
}

// Length, mm, of the interval of possible centres of a path in `size` strips.
template <class T>
T anywhere(T size, T extent, double pitch) {
  return larger(abs(size * pitch - extent), pitch);
}

template <class T>
T delta_adds(T strips, const T& delta_strips) {
  return select(strips > 0.0, delta_strips / larger(strips, 1.0), select(strips == 0.0, T(1.0), T(0.0)));
}

// Variance in squared pitches of a position that is uniform in an interval and displaced by half a strip for
// each strip added.
template <class T>
T position_variance(T added, T interval, double least_width) {
  const T width = larger(interval, least_width);
  return added * added * 0.25 + width * width * (1.0 / 12);
}

// Variance, mm^2, of the position of a cluster of `size` strips for a path of this extent, mm.
// `least_width`: smallest interval, in pitches. `delta_strips` grows with the square of the particle's
// charge.
template <class T>
T cluster_variance(T size, T extent, double pitch, double least_width, const T& delta_strips) {
  const auto [whole, part] = touched(extent, pitch);
  const T added = size - 1.0 - whole;
  const T fewer = (1.0 - part) * delta_adds(added, delta_strips),
          more = part * delta_adds(added - 1.0, delta_strips);
  const T both = fewer + more;
  const T mixture = fewer * position_variance<T>(added, 1.0 - part, least_width) +
                    more * position_variance<T>(added - 1.0, part, least_width);
  const T somewhere = anywhere(size, extent, pitch);
  const mask_of<T> can_be = both > 0.0;
  return select(can_be, pitch * pitch * mixture / select(can_be, both, T(1.0)),
                somewhere * somewhere * (1.0 / 12));
}

// Variance, mm^2, that the inclination of the path adds to a position measured by a layer whose errors grow
// with it.
template <class T>
T inclined_variance(const MeasuringLayer& layer, const T& extent) {
  return layer.slope > 0 ? layer.slope * layer.slope * extent * extent : T(0.0);
}

}  // namespace cgemit

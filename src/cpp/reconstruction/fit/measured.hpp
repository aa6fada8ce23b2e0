// The measurement of each hit on the present reference: value, variance, and side of the wire.
#pragma once

#include "common/compiler.hpp"
#include "kalman/group.hpp"
#include "readout/cluster_errors.hpp"
#include "reconstruction/fit/fit.hpp"

namespace cgemit {

// `charge2`: e^2, of the particles; they make so many times more delta electrons. `wires_only`: lanes that do
// not use their clusters yet.
template <class T>
CGEMIT_FLATTEN void fill_slots(Group<T>& group, const Detector& detector, const FitSettings& settings,
                               const T& charge2, mask_of<T> wires_only) {
  const T delta_strips = settings.delta_strips * charge2;
  for (Slot<T>& slot : group.slots) {
    slot.used = slot.met & !slot.outlier;
    if (slot.view == View::wire) {
      // A drift distance is a mixture of two sides; its mean and variance follow from the present weight of
      // each.
      slot.value = slot.weight * slot.drift;
      slot.variance = slot.noise + (1.0 - slot.weight * slot.weight) * slot.drift * slot.drift;
    } else {
      slot.value = slot.drift;
      slot.variance = slot.noise;
      slot.used = slot.used & !wires_only;
      if (settings.errors_from_track) {
        const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(slot.layer)];
        const double pitch = slot.view == View::x ? layer.pitch_x : layer.pitch_v;
        const T from_track =
            cluster_variance(slot.size, slot.extent, pitch, settings.least_width, delta_strips);
        slot.variance = select(slot.met & (slot.size > 0.0), from_track,
                               slot.variance + inclined_variance(layer, slot.extent));
      }
    }
    slot.residual = select(slot.met, slot.value - slot.predicted, T(0.0));
  }
}

// Projection of the path in a drift gap on X or V, mm, with a sign, for a helix without matter.
template <class T>
T extent_of(const MeasuringLayer& layer, View view, const PerigeeOf<T>& helix, double bz) {
  const double r = layer.r_mid(), gap = layer.r_gap_out - layer.r_gap_in;
  // Between flight and radius, from dS/d(r^2) = w/2 (motion/helix.hpp).
  const T sine = (helix.d + 0.5 * curvature(bz, helix.kappa) * (r * r - helix.d * helix.d)) * (1 / r);
  const T per_cosine = 1.0 / sqrt(larger(1.0 - sine * sine, 1e-6));
  const T x = (layer.r_readout / r * gap) * sine * per_cosine;
  if (view == View::x) return x;
  return layer.cos_stereo * x - (layer.sin_stereo * gap) * per_cosine * helix.tanl;
}

// Extents of the lanes `who`, traced for the helix `before`, for the helix `now` close to it.
template <class T>
void follow_extents(Group<T>& group, const Detector& detector, const PerigeeOf<T>& before,
                    const PerigeeOf<T>& now, mask_of<T> who) {
  for (Slot<T>& slot : group.slots) {
    if (slot.view == View::wire) continue;
    const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(slot.layer)];
    const T from = extent_of(layer, slot.view, before, detector.bz);
    const T to = extent_of(layer, slot.view, now, detector.bz);
    slot.extent = select(who, abs(copysign(slot.extent, from) + to - from), slot.extent);
  }
}

// Probability of each side from the track fitted without the hit. `early`: the errors of the predictions are
// underestimated. True where no weight changed any more.
template <class T>
CGEMIT_FLATTEN mask_of<T> renew_sides(Group<T>& group, mask_of<T> who, bool early) {
  const double caution = early ? 4.0 : 1.0;
  T largest(0.0);
  for (Slot<T>& slot : group.slots) {
    if (slot.view != View::wire) continue;
    const mask_of<T> open = who & slot.met & (slot.known_side == 0.0);
    if (!any(open)) continue;
    const T predicted = slot.value - slot.unbiased;
    const T spread = larger(slot.unbiased_variance - slot.variance, 0.0);
    const T weight = hyperbolic_tangent(slot.drift * predicted / (slot.noise + caution * spread));
    largest = larger(largest, select(open, abs(weight - slot.weight), T(0.0)));
    slot.weight = select(open, weight, slot.weight);
  }
  return largest < 0.02;
}

}  // namespace cgemit

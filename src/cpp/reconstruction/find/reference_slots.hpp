// What the filters of the finder share: the trace of a reference that meets the hits near it, and the errors
// of these hits.
#pragma once

#include <algorithm>
#include <cmath>

#include "kalman/field_reference.hpp"
#include "kalman/tracer.hpp"
#include "readout/cluster_errors.hpp"
#include "reconstruction/find/find.hpp"
#include "reconstruction/find/nearby.hpp"

namespace cgemit {

inline void trace_nearby(const Detector& detector, const Perigee& start, const FindSettings& settings,
                         Group<double>& group, NearbyHits& nearby) {
  const Species species = species_of(settings, start.kappa);
  const NearbyObserver observer(nearby);
  const MatterMomentum<double> matter{settings.momentum > 0, settings.momentum};
  if (detector.field.is_uniform())
    Tracer<double, HelixMotion<double>, NearbyObserver>(detector, start, species, group, observer, matter)
        .run(true);
  else
    Tracer<double, FieldReference<double>, NearbyObserver>(detector, start, species, group, observer, matter)
        .run(true);
}

inline double variance_of(const Detector& detector, const FindSettings& settings, const Slot<double>& slot) {
  const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(slot.layer)];
  if (slot.size <= 0) return slot.noise + inclined_variance(layer, slot.extent);
  const double pitch = slot.view == View::x ? layer.pitch_x : layer.pitch_v;
  return cluster_variance(slot.size, slot.extent, pitch, settings.least_width,
                          settings.delta_strips * settings.charge * settings.charge);
}

// The measurement of a slot for the filter; that of a wire on the side of its weight, right minus left
// probability.
inline void measure(const Detector& detector, const FindSettings& settings, Slot<double>& slot) {
  if (slot.view == View::wire) {
    slot.value = slot.weight * slot.drift;
    slot.variance = slot.noise + (1 - slot.weight * slot.weight) * slot.drift * slot.drift;
  } else {
    slot.value = slot.drift;
    slot.variance = variance_of(detector, settings, slot);
  }
  slot.residual = slot.value - slot.predicted;
}

// The side of a wire after the smoother, from the track without this hit.
inline void choose_side(Slot<double>& slot) {
  const double spread = std::max(slot.unbiased_variance - slot.variance, 0.0);
  slot.weight = std::tanh(slot.drift * (slot.value - slot.unbiased) / (slot.noise + spread));
}

}  // namespace cgemit

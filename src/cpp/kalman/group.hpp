// Tracks side by side, one per lane, with all their measurements, ordered from the beam line outward.
//
// All lanes cross the same slabs. Between two slabs each track has measurements of its own: slot number n
// between them holds the n-th measurement of each lane there, or none.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <span>
#include <type_traits>
#include <vector>

#include "common/angles.hpp"
#include "detector/detector.hpp"
#include "kalman/vector.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// Whether tracks are fitted as straight lines in a field (T at the origin): it bends a track of 1 GeV/c by 2
// um over 0.8 m. Their kappa is that of an assumed momentum.
inline constexpr double straight_field = 1e-4;
inline bool is_straight(double bz) { return std::abs(bz) < straight_field; }

enum class View : std::uint8_t { x = 0, v = 1, wire = 2 };

// One scalar measurement. Ordered from the beam line outward within a track.
struct Hit {
  View view;
  std::int32_t layer;    // index into the detector's layers or wires
  std::int32_t channel;  // sheet or wire
  std::int32_t size;     // strips in the cluster; 0: no strips
  double value;          // mm: X or V on the sheet, or drift distance
  double sigma;          // mm
  // For the V of a point that measures X and V together, uncorrelated with its X: `value` is V - k X with the
  // measured X, and k is their covariance over the variance of X. k = 0: V alone.
  double k = 0, x = 0;
};

// One measurement per lane.
template <class T>
struct Slot {
  View view;
  std::int32_t layer;  // index into the detector's layers or wires
  // Number among the track's hits, -1: none; of an expected hit (`covariance/`) its channel.
  std::array<std::int32_t, lanes_of<T>> hit;
  mask_of<T> there;
  // The measurement:
  T drift;  // mm: X, V or drift distance
  T noise;  // mm^2
  T size;   // strips
  T edge;   // rad, azimuth where X begins
  T known_side;
  T k, x;  // V: as in Hit
  WireOf<T> wire;
  // Set by the fit: right minus left probability; whether the hit is an outlier.
  T weight;
  mask_of<T> outlier;
  // Where the reference crosses it:
  mask_of<T> met;
  T predicted;  // mm, in the hit's own coordinate; wires: signed distance
  T extent;     // mm, projection of the path in the drift gap on X or V; 0 for wires
  Five<T> row;
  // Input of the filter, and its results for the smoother:
  mask_of<T> used;
  T value, variance, residual;  // measured; residual to the reference
  Five<T> ch;                   // C h before the update
  T innovation, total;          // residual before the update, and its variance
  T inverse;                    // 1/total, 0 if not used
  // Set by the smoother: the residual to the track fitted without this hit, and its variance, which includes
  // the measurement's own.
  T unbiased, unbiased_variance;
};

// Empties a slot. The fields that the reference, the filter and the smoother write are left as they are.
template <class T>
void empty(Slot<T>& slot) {
  slot.there = slot.outlier = mask_of<T>(false);
  slot.noise = slot.size = 1.0;
  slot.drift = slot.edge = slot.known_side = slot.weight = 0.0;
  slot.k = slot.x = 0.0;
  slot.wire = {T(0.0), T(0.0), T(0.0), T(0.0), T(1.0)};
}

// Noise of a slab in the coordinates of the origin, (d, psi, kappa, z0, tanl). A turn or shift of the track
// at fixed kappa and tanl changes d, psi and z0 only; straggling does not change tanl.
template <class T>
struct SlabNoise {
  Five<T> dip;
  std::array<T, 4> straggling;
  std::array<T, 3> turn, shift_across, shift_along;
};

// The same in a field map, where a turn or shift also changes kappa and tanl at the origin.
template <class T>
struct DenseNoise {
  Five<T> dip, straggling, turn, shift_across, shift_along;
};

// Scattering angles (kinks) of the reference in a slab, as estimated by the previous iteration: two angles in
// rad across the flight before the slab, horizontal and the other. (Such kinks are among the unknowns of the
// fits of V. Blobel, NIM A 566 (2006) 14.) The noise is defined across the flight after the slab, whose
// horizontal axis is turned by the angle with this cosine and sine.
template <class T>
struct Kink {
  T aside, up;
  T sigma;  // rad, standard deviation of each
  T cosine, sine;
};

// The kinks in units of the noise: a turn and a change of dip.
template <class T>
std::array<T, 2> in_noise_units(const Kink<T>& kink) {
  const T per_sigma = select(kink.sigma > 0.0, 1.0 / kink.sigma, T(0.0));
  return {per_sigma * (kink.cosine * kink.aside + kink.sine * kink.up),
          per_sigma * (kink.cosine * kink.up - kink.sine * kink.aside)};
}

// A slab with the clusters in its gap, measured before the track scatters in the slab; or a set of wires.
struct GroupStep {
  bool is_slab;
  std::int32_t slab, noise;  // which slab, and the index of its noise
  std::int32_t first, last;  // slots
};

// A mask in a vector. For one track std::vector<bool> would pack it to single bits.
template <class T>
using StoredMask = std::conditional_t<lanes_of<T> == 1, std::uint8_t, mask_of<T>>;

template <class T>
struct Group {
  std::vector<GroupStep> steps;
  std::span<Slot<T>> slots;
  std::vector<Slot<T>> storage;            // of the slots; grows to the size of the largest group
  std::vector<SlabNoise<T>> noise;         // one per slab of `steps`, all zero where it was not crossed
  std::vector<DenseNoise<T>> dense_noise;  // instead of `noise` in a field map; else empty
  bool dense = false;                      // whether the last trace was in a field map
  std::vector<StoredMask<T>> ahead;        // the same: lanes with measurements beyond
  mask_of<T> kinked{false};                // lanes whose reference has kinks
  std::vector<Kink<T>> kinks;              // one per slab of `steps`; unused in other lanes
  // After a trace: hits met; whether the particle ran out of momentum before the next one.
  std::array<std::int32_t, lanes_of<T>> reached{};
  mask_of<T> stopped{false};
  mask_of<T> left{false};  // whether it left the field map
};

// The steps of a detector, without hits.
template <class T>
Group<T> empty_group(const Detector& detector) {
  Group<T> group;
  std::int32_t slabs = 0;
  for (const Surface& surface : detector.surfaces)
    group.steps.push_back(
        {surface.is_slab, surface.is_slab ? surface.index : -1, surface.is_slab ? slabs++ : -1, 0, 0});
  const auto n = static_cast<std::size_t>(slabs);
  group.noise.resize(n);
  group.dense_noise.resize(detector.field.is_uniform() ? 0 : n);
  group.kinks.resize(n);
  return group;
}

// Kinks for a single track: two angles for every slab of the detector, or none at all.
inline void set_kinks(Group<double>& group, std::span<const double> kinks) {
  group.kinked = std::ranges::any_of(kinks, [](double angle) { return angle != 0; });
  if (!group.kinked) return;
  for (const GroupStep& step : group.steps) {
    if (!step.is_slab) continue;
    const double* angles = &kinks[2 * static_cast<std::size_t>(step.slab)];
    group.kinks[static_cast<std::size_t>(step.noise)] = {angles[0], angles[1], 0, 1, 0};
  }
}

// Fills in `ahead`, at the start and after hits were given up.
template <class T>
void look_ahead(Group<T>& group) {
  group.ahead.resize(group.noise.size());
  mask_of<T> beyond(false);
  for (std::size_t i = group.steps.size(); i-- > 0;) {
    const GroupStep& step = group.steps[i];
    if (step.is_slab) group.ahead[static_cast<std::size_t>(step.noise)] = beyond;
    for (std::int32_t s = step.first; s < step.last; ++s)
      beyond = beyond | group.slots[static_cast<std::size_t>(s)].there;
  }
}

}  // namespace cgemit

// Tracks side by side, one per lane, and everything that they measured, ordered from the beam line outward.
//
// All lanes walk through the same slabs. Between two slabs each track has measurements of its own: slot
// number n of a stretch holds the n-th measurement that each lane has there, or none.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "common/angles.hpp"
#include "detector/detector.hpp"
#include "kalman/vector.hpp"

namespace cgemit {

enum class View : std::uint8_t { x = 0, v = 1, wire = 2 };

// One scalar measurement. Ordered from the beam line outward within a track.
struct Hit {
  View view;
  std::int32_t layer;    // index into the detector's cgem or wires
  std::int32_t element;  // sheet or wire
  std::int32_t size;     // strips in the cluster; 0: no strips
  double value;          // mm: X or V on the sheet, or drift distance
  double sigma;          // mm
};

// Flight parameters at the origin: psi is the flight azimuth, phi0 + pi/2.
template <class T>
struct PerigeeOf {
  T d, psi, kappa, z0, tanl;
};
using Perigee = PerigeeOf<double>;

// One measurement per lane.
template <class T>
struct Slot {
  View view;
  std::int32_t layer;                         // clusters: index into the detector's cgem
  std::array<std::int32_t, lanes_of<T>> hit;  // number among the track's hits, -1: none
  mask_of<T> there;
  // What was measured:
  T drift;  // mm: X, V or drift distance
  T noise;  // mm^2
  T size;   // strips
  T edge;   // rad, azimuth where X begins
  T known_side;
  WireOf<T> wire;
  // What the fit makes of it: right minus left probability; whether it counts as an outlier.
  T weight;
  mask_of<T> outlier;
  // Where the reference meets it:
  mask_of<T> met;
  T predicted;  // mm, in the hit's own coordinate; wires: signed distance
  T extent;     // mm, projection of the path in the drift gap on X or V; 0 for wires
  Five<T> row;
  // What the filter sees, and what it leaves behind for the smoother:
  mask_of<T> used;
  T value, variance, residual;  // measured; residual to the reference
  Five<T> ch;                   // C h before the update
  T innovation, total;          // residual before the update, and its variance
  // What the smoother adds: the residual to all other measurements and its variance, the measurement's own
  // included.
  T unbiased, unbiased_variance;
};

// Noise of a slab in the coordinates of the origin. Of (d, psi, kappa, z0, tanl), what turns or shifts a
// track at fixed kappa and tanl moves d, psi and z0 only; straggling leaves tanl alone.
template <class T>
struct SlabNoise {
  Five<T> dip;
  std::array<T, 4> straggling;
  std::array<T, 3> turn, shift_across, shift_along;
};

// A slab with the clusters in its gap, which the track makes before it is scattered there, or wires.
struct GroupStep {
  bool is_slab;
  std::int32_t slab, noise;  // which slab, and where its noise is
  std::int32_t first, last;  // slots
};

template <class T>
struct Group {
  std::vector<GroupStep> steps;
  std::span<Slot<T>> slots;
  std::vector<Slot<T>> storage;     // of the slots; grows to what the largest group needed
  std::vector<SlabNoise<T>> noise;  // one per slab of `steps`, all zero where it was not crossed
  std::vector<mask_of<T>> ahead;    // the same: lanes that have measurements beyond
  // After a trace: hits met; whether the particle ran out of momentum on the way to the next.
  std::array<std::int32_t, lanes_of<T>> reached;
  mask_of<T> stopped;
};

// Sorts the hits of up to `lanes_of<T>` tracks into slots. Fewer tracks leave lanes without hits.
template <class T>
class GroupBuilder {
 public:
  GroupBuilder(const Detector& detector, Group<T>& group) : detector_(detector), group_(group) {}

  void build(std::span<const std::span<const Hit>> hits,
             std::span<const std::span<const std::int8_t>> sides) {
    hits_ = hits;
    sides_ = sides;
    at_ = {};
    group_.steps.clear();
    slots_ = 0;
    std::int32_t slabs = 0;
    for (const Place& place : detector_.places) {
      if (!place.is_slab) {
        take_wires(place.index);
      } else if (finished()) {
        break;
      } else {
        take_clusters(place.index, slabs++);
      }
    }
    group_.slots = std::span(group_.storage).first(static_cast<std::size_t>(slots_));
    group_.noise.resize(static_cast<std::size_t>(slabs));
    look_ahead(group_);
  }

  // After slots were given up, too.
  static void look_ahead(Group<T>& group) {
    group.ahead.resize(group.noise.size());
    mask_of<T> beyond(false);
    for (std::size_t i = group.steps.size(); i-- > 0;) {
      const GroupStep& step = group.steps[i];
      if (step.is_slab) group.ahead[static_cast<std::size_t>(step.noise)] = beyond;
      for (std::int32_t s = step.first; s < step.last; ++s)
        beyond = beyond | group.slots[static_cast<std::size_t>(s)].there;
    }
  }

 private:
  bool finished() const {
    for (std::size_t k = 0; k < hits_.size(); ++k)
      if (at_[k] < hits_[k].size()) return false;
    return true;
  }

  // Layers of wires between the same slabs share their slots.
  void take_wires(std::int32_t layer) {
    const bool joins = !group_.steps.empty() && !group_.steps.back().is_slab;
    if (!joins) {
      group_.steps.push_back({false, -1, -1, slots_, slots_});
      filled_ = {};
    }
    for (std::size_t k = 0; k < hits_.size(); ++k) {
      for (; meets(k, at_[k], layer, true); ++at_[k]) place(group_.steps.back().first, k, at_[k]);
    }
    group_.steps.back().last = slots_;
  }

  // First the X clusters of all lanes, then the V clusters.
  void take_clusters(std::int32_t slab, std::int32_t noise) {
    const std::int32_t begin = slots_, gap = detector_.slabs[static_cast<std::size_t>(slab)].gap;
    for (const View view : {View::x, View::v}) {
      const std::int32_t first = slots_;
      filled_ = {};
      for (std::size_t k = 0; k < hits_.size(); ++k) {
        for (std::size_t i = at_[k]; meets(k, i, gap, false); ++i)
          if (hits_[k][i].view == view) place(first, k, i);
      }
    }
    for (std::size_t k = 0; k < hits_.size(); ++k)
      while (meets(k, at_[k], gap, false)) ++at_[k];
    group_.steps.push_back({true, slab, noise, begin, slots_});
  }

  bool meets(std::size_t track, std::size_t i, std::int32_t layer, bool wire) const {
    if (i >= hits_[track].size()) return false;
    const Hit& hit = hits_[track][i];
    return (hit.view == View::wire) == wire && hit.layer == layer;
  }

  void place(std::int32_t first, std::size_t track, std::size_t i) {
    const Hit& hit = hits_[track][i];
    const std::int32_t number = first + filled_[track]++;
    if (number == slots_) empty(hit.view, hit.layer);
    fill(group_.storage[static_cast<std::size_t>(number)], static_cast<int>(track), hit, i);
  }

  // One slot more, without a measurement. What the reference, the filter and the smoother write stays as it
  // was.
  void empty(View view, std::int32_t layer) {
    const auto number = static_cast<std::size_t>(slots_++);
    if (number == group_.storage.size()) group_.storage.emplace_back();
    Slot<T>& slot = group_.storage[number];
    slot.view = view;
    slot.layer = layer;
    slot.hit.fill(-1);
    slot.there = slot.outlier = mask_of<T>(false);
    slot.noise = slot.size = 1.0;
    slot.drift = slot.edge = slot.known_side = slot.weight = 0.0;
    slot.wire = {T(0.0), T(0.0), T(0.0), T(0.0), T(1.0)};
  }

  void fill(Slot<T>& slot, int k, const Hit& hit, std::size_t number) {
    const auto track = static_cast<std::size_t>(k);
    slot.hit[track] = static_cast<std::int32_t>(number);
    set_lane(slot.there, k, true);
    set_lane(slot.drift, k, hit.value);
    set_lane(slot.noise, k, hit.sigma * hit.sigma);
    const auto layer = static_cast<std::size_t>(hit.layer), element = static_cast<std::size_t>(hit.element);
    if (hit.view != View::wire) {
      set_lane(slot.size, k, hit.size);
      set_lane(slot.edge, k, wrap_angle(detector_.cgem[layer].phi_first[element]));
      return;
    }
    const Wire& wire = detector_.wires[layer].placed[element];
    set_lane(slot.wire.x, k, wire.x);
    set_lane(slot.wire.y, k, wire.y);
    set_lane(slot.wire.ex, k, wire.ex);
    set_lane(slot.wire.ey, k, wire.ey);
    set_lane(slot.wire.ez, k, wire.ez);
    set_lane(slot.known_side, k, sides_[track][number]);
    set_lane(slot.weight, k, sides_[track][number]);
  }

  const Detector& detector_;
  Group<T>& group_;
  std::span<const std::span<const Hit>> hits_;
  std::span<const std::span<const std::int8_t>> sides_;
  std::array<std::size_t, lanes_of<T>> at_{};
  std::array<std::int32_t, lanes_of<T>> filled_{};
  std::int32_t slots_ = 0;
};

}  // namespace cgemit

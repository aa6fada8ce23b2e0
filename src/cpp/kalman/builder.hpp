// Sorts the hits of up to `lanes_of<T>` tracks into the slots of a group.
#pragma once

#include <algorithm>

#include "common/compiler.hpp"
#include "detector/wires.hpp"
#include "kalman/group.hpp"

namespace cgemit {

template <class T>
class GroupBuilder {
 public:
  explicit GroupBuilder(const Detector& detector)
      : detector_(detector), gap_step_(detector.layers.size(), -1), wire_step_(detector.wires.size(), -1) {
    std::int32_t slabs = 0;
    for (const Surface& surface : detector.surfaces) {
      const auto index = static_cast<std::size_t>(surface.index);
      if (surface.is_slab) {
        const int gap = detector.slabs[index].gap;
        if (gap >= 0) gap_step_[static_cast<std::size_t>(gap)] = static_cast<std::int32_t>(steps_.size());
        steps_.push_back({true, surface.index, slabs++, 0, 0});
      } else {
        // Layers of wires between the same slabs share their slots.
        if (steps_.empty() || steps_.back().is_slab) steps_.push_back({false, -1, -1, 0, 0});
        wire_step_[index] = static_cast<std::int32_t>(steps_.size()) - 1;
      }
    }
  }

  // `sides` per hit: +1 or -1 known, 0 unknown. With fewer tracks than lanes, the other lanes have no hits.
  // If the hits of a track are not ordered outward, the rest of the track is left out.
  void build(std::span<const std::span<const Hit>> hits, std::span<const std::span<const std::int8_t>> sides,
             Group<T>& group) {
    const std::size_t steps = count(hits);
    group.steps.assign(steps_.begin(), steps_.begin() + static_cast<std::ptrdiff_t>(steps));
    first_.resize(2 * steps);
    std::int32_t slots = 0, slabs = 0;
    for (std::size_t i = 0; i < steps; ++i) {
      GroupStep& step = group.steps[i];
      slabs += step.is_slab ? 1 : 0;
      step.first = first_[2 * i] = slots;
      first_[2 * i + 1] = slots + most_[2 * i];
      step.last = slots += most_[2 * i] + most_[2 * i + 1];
    }
    if (group.storage.size() < static_cast<std::size_t>(slots))
      group.storage.resize(static_cast<std::size_t>(slots));
    group.slots = std::span(group.storage).first(static_cast<std::size_t>(slots));
    group.noise.resize(static_cast<std::size_t>(slabs));
    group.kinks.resize(static_cast<std::size_t>(slabs));
    group.kinked = mask_of<T>(false);
    group.dense_noise.resize(detector_.field.is_uniform() ? 0 : static_cast<std::size_t>(slabs));
    for (Slot<T>& slot : group.slots) slot.hit.fill(-1);
    for (std::size_t k = 0; k < hits.size(); ++k) place_track(k, hits[k], group);
    // Slot by slot: a group of tracks is larger than the processor's cache.
    for (Slot<T>& slot : group.slots) {
      empty(slot);
      for (std::size_t k = 0; k < hits.size(); ++k) {
        if (slot.hit[k] < 0) continue;
        const auto i = static_cast<std::size_t>(slot.hit[k]);
        fill(slot, static_cast<int>(k), hits[k][i], sides[k][i]);
      }
    }
    look_ahead(group);
  }

 private:
  std::size_t step_of(const Hit& hit) const {
    const auto layer = static_cast<std::size_t>(hit.layer);
    return static_cast<std::size_t>(hit.view == View::wire ? wire_step_[layer] : gap_step_[layer]);
  }

  const Wire& wire_of(const Hit& hit) const {
    return detector_.wires[static_cast<std::size_t>(hit.layer)].placed[static_cast<std::size_t>(hit.channel)];
  }

  // f(hit number, step, second, number): `second` is true for V clusters, which follow the X clusters of all
  // lanes; `number` counts the earlier hits of the same kind that the track has in this step.
  template <class F>
  void walk(std::span<const Hit> hits, F&& f) const {
    std::size_t step = 0;
    std::array<std::int32_t, 2> before{};
    for (std::size_t i = 0; i < hits.size(); ++i) {
      const std::size_t next = step_of(hits[i]);
      if (next < step || next >= steps_.size()) return;
      if (next > step) before = {};
      step = next;
      const std::size_t second = hits[i].view == View::v ? 1 : 0;
      f(i, step, second, before[second]++);
    }
  }

  // The largest number of slots that each step needs. Returns the number of steps up to the last hit. Wires
  // are spread over the memory; they are prefetched here for the filling of the slots.
  std::size_t count(std::span<const std::span<const Hit>> hits) {
    most_.assign(2 * steps_.size(), 0);
    std::size_t steps = 0;
    for (const auto& track : hits) {
      walk(track, [&](std::size_t i, std::size_t step, std::size_t second, std::int32_t before) {
        if (track[i].view == View::wire) prefetch(wire_of(track[i]));
        std::int32_t& most = most_[2 * step + second];
        most = std::max(most, before + 1);
        steps = std::max(steps, step + 1);
      });
    }
    return steps;
  }

  void place_track(std::size_t k, std::span<const Hit> hits, Group<T>& group) const {
    walk(hits, [&](std::size_t i, std::size_t step, std::size_t second, std::int32_t before) {
      Slot<T>& slot = group.slots[static_cast<std::size_t>(first_[2 * step + second] + before)];
      slot.view = hits[i].view;
      slot.layer = hits[i].layer;
      slot.hit[k] = static_cast<std::int32_t>(i);
    });
  }

  void fill(Slot<T>& slot, int k, const Hit& hit, double side) const {
    set_lane(slot.there, k, true);
    set_lane(slot.drift, k, hit.value);
    set_lane(slot.noise, k, hit.sigma * hit.sigma);
    if (hit.view != View::wire) {
      const MeasuringLayer& layer = detector_.layers[static_cast<std::size_t>(hit.layer)];
      set_lane(slot.size, k, hit.size);
      set_lane(slot.k, k, hit.k);
      set_lane(slot.x, k, hit.x);
      set_lane(slot.edge, k, wrap_angle(layer.phi_first[static_cast<std::size_t>(hit.channel)]));
      return;
    }
    const Wire& wire = wire_of(hit);
    set_lane(slot.wire.x, k, wire.x);
    set_lane(slot.wire.y, k, wire.y);
    set_lane(slot.wire.ex, k, wire.ex);
    set_lane(slot.wire.ey, k, wire.ey);
    set_lane(slot.wire.ez, k, wire.ez);
    set_lane(slot.known_side, k, side);
    set_lane(slot.weight, k, side);
  }

  const Detector& detector_;
  std::vector<GroupStep> steps_;                    // of a track that reaches the outermost layer
  std::vector<std::int32_t> gap_step_, wire_step_;  // where the hits of a layer belong
  std::vector<std::int32_t> most_, first_;          // slots of each step: X clusters or wires, V clusters
};

}  // namespace cgemit

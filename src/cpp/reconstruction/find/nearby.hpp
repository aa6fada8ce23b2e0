// The observer of a trace that fills the slots of a group with the hits near the reference, and with the
// cells that it crosses and that did not fire.
#pragma once

#include <algorithm>
#include <cmath>
#include <optional>

#include "common/compiler.hpp"
#include "detector/strip_plane.hpp"
#include "kalman/tracer.hpp"
#include "motion/cells.hpp"
#include "motion/reach.hpp"
#include "motion/uniform.hpp"
#include "reconstruction/find/event_hits.hpp"

namespace cgemit {

class NearbyHits {
 public:
  NearbyHits(const Detector& detector, Group<double>& group)
      : detector_(detector), group_(group), steps_(detector), expected_(detector.surfaces.size()) {
    group_ = empty_group<double>(detector);
    group_.ahead.assign(group_.noise.size(), true);
  }
  NearbyHits(const NearbyHits&) = delete;  // `cells_` refers to `steps_`
  NearbyHits& operator=(const NearbyHits&) = delete;

  // Before each trace. `wide`: whether the reference may be some cells away from the track; `taken`: whether
  // wire hits of tracks beyond doubt count.
  void begin(const EventHits& hits, bool wide, bool taken = false) {
    hits_ = &hits;
    taken_ = taken;
    cells_.emplace(detector_, steps_);  // anew: it counts azimuths from one layer to the next
    window_ = wide ? 25 : 8;
    beside_ = wide ? 2 : 1;
    reach_ = {};
    next_ = 0;
    layer_ = 0;
    group_.slots = {};
    for (GroupStep& step : group_.steps) step.first = step.last = 0;
    std::ranges::fill(expected_, false);
  }

  void reaches(GroupStep& step, const Slab& slab, const HelixPoint& at, bool reached) {
    step.first = step.last = next_;
    if (reached && slab.ends.miss(at.z)) reach_.miss(detector_, slab, at, true, false);
    if (slab.gap < 0 || !reached || !reach_.parts) return;
    const auto index = static_cast<std::size_t>(slab.gap);
    const MeasuringLayer& layer = detector_.layers[index];
    if (layer.ends.miss(at.z, 2 * window_)) return;
    const double phi = std::atan2(at.y, at.x), around = 2 * pi * layer.r_readout;
    for (int sheet = 0; sheet < layer.sheets; ++sheet) {
      const double x = local_x(layer, sheet, phi);
      const double edge = layer.dead_seam > 0 ? seam + 0.5 * layer.dead_seam : seam;
      const bool whole = layer.sheets == 1 && layer.dead_seam == 0;
      const bool on = whole || (x > edge && x < layer.sheet_width() - edge);
      if (on && !layer.between_ladders(x, seam) && layer.ends.hold(at.z, -layer.dead_ends - seam))
        expected_[number(step)] = true;
    }
    for (const View view : {View::x, View::v}) {
      for (std::int32_t id = hits_->first(index, view); id < hits_->last(index, view); ++id) {
        const Hit& hit = (*hits_)[id];
        double x = local_x(layer, hit.channel, phi);
        if (x > 0.5 * (around + layer.sheet_width())) x -= around;
        if (x < -window_ || x > layer.sheet_width() + window_) continue;
        const double off = hit.value - (view == View::x ? x : local_v(layer, x, at.z));
        const double turn = view == View::x ? around : around * layer.cos_stereo;
        const double least = layer.sheets == 1
                                 ? std::min(std::abs(off), std::abs(std::abs(off) - std::abs(turn)))
                                 : std::abs(off);
        if (least < window_) add_cluster(step, id, hit, layer);
      }
    }
  }

  CGEMIT_FLATTEN void passes(GroupStep& step, const HelixPoint& at, bool alive) {
    step.first = step.last = next_;
    const std::size_t index = layer_++;
    if (!alive || !reach_.chamber || !at.is_outward()) return;
    const WireLayer& layer = detector_.wires[index];
    CellRange<double, HelixPoint> range;
    // Not met are layers below the closest approach and those that the track does not reach.
    if (!cells_->find(index, at, true, range)) return;
    // Along the flight: cells before the first hit of a particle are no holes.
    const double side = at.sideways() < 0 ? -1 : 1, begin = side < 0 ? range.last : range.first,
                 count = std::min(range.last - range.first, most_cells);
    // The reference may be a cell off, which is more cells away along the layer where it crosses obliquely.
    const HelixPoint& there = range.at_wires;
    const double oblique = std::sqrt(there.x * there.x + there.y * there.y) / std::max(there.outward(), 1e-9),
                 beside = std::floor(beside_ * std::min(oblique, most_oblique) + 0.5);
    std::int64_t next = cell_numbers(layer, begin - side * beside)[0];
    for (double c = -beside; c <= count + beside; c += 1) {
      const std::int64_t cell = next;
      next = side < 0 ? (cell > 0 ? cell : layer.cells) - 1 : (cell + 1 < layer.cells ? cell + 1 : 0);
      const std::int32_t id = hits_->at(index, cell);
      const bool crossed = c >= 0 && c <= count && !layer.is_masked(static_cast<std::size_t>(cell));
      if (id < 0 ? !crossed : !taken_ && hits_->is_taken(id)) continue;
      Slot<double>& slot = add(step, View::wire, index, id);
      slot.wire = layer.placed[static_cast<std::size_t>(cell)];
      if (id < 0) continue;
      slot.drift = (*hits_)[id].value;
      slot.noise = (*hits_)[id].sigma * (*hits_)[id].sigma;
    }
  }

  bool on_wire(const Slot<double>& slot, double z) const {
    return detector_.wires[static_cast<std::size_t>(slot.layer)].ends.hold(z);
  }

  // Whether the reference crosses the active area of the gap of this step, away from its edges.
  bool expects(const GroupStep& step) const { return expected_[number(step)]; }

 private:
  static constexpr double seam = 3;  // mm
  static constexpr double most_cells = 12, most_oblique = 4;

  std::size_t number(const GroupStep& step) const {
    return static_cast<std::size_t>(&step - group_.steps.data());
  }

  Slot<double>& add(GroupStep& step, View view, std::size_t layer, std::int32_t id) {
    const auto used = static_cast<std::size_t>(next_);
    if (used == group_.storage.size()) group_.storage.resize(2 * used + 64);
    group_.slots = std::span(group_.storage).first(used + 1);
    step.last = ++next_;
    Slot<double>& slot = group_.storage[used];
    empty(slot);
    slot.view = view;
    slot.layer = static_cast<std::int32_t>(layer);
    slot.hit[0] = id;
    slot.there = true;
    slot.used = false;
    slot.variance = 1;
    slot.residual = 0;
    return slot;
  }
  void add_cluster(GroupStep& step, std::int32_t id, const Hit& hit, const MeasuringLayer& layer) {
    Slot<double>& slot = add(step, hit.view, static_cast<std::size_t>(hit.layer), id);
    slot.drift = hit.value;
    slot.noise = hit.sigma * hit.sigma;
    slot.size = hit.size;
    slot.edge = wrap_angle(layer.phi_first[static_cast<std::size_t>(hit.channel)]);
    slot.k = hit.k;
    slot.x = hit.x;
  }

  const Detector& detector_;
  Group<double>& group_;
  const EventHits* hits_ = nullptr;
  UniformMotionOf<double>
      steps_;  // to the next layer of wires; short, so that the field is as at the last one
  std::optional<CellFinder<double, UniformMotionOf<double>>> cells_;
  std::vector<std::uint8_t> expected_;
  double window_ = 0;  // mm, about the reference
  double beside_ = 0;  // cells beside those that the reference crosses
  bool taken_ = false;
  Reach<double> reach_;
  std::size_t layer_ = 0;
  std::int32_t next_ = 0;
};

// Passed to the tracer by value.
class NearbyObserver : public NoObserver {
 public:
  static constexpr bool provides_hits = true, stops_at_wires = false;
  explicit NearbyObserver(NearbyHits& hits) : hits_(&hits) {}

  template <class Motion>
  void reaches(GroupStep& step, const Slab& slab, const Motion& motion, bool reached) {
    hits_->reaches(step, slab, motion.point(), reached);
  }
  template <class Motion>
  void passes(GroupStep& step, const Motion& motion, bool alive) {
    hits_->passes(step, motion.point(), alive);
  }
  bool on_wire(const Slot<double>& slot, double z) const { return hits_->on_wire(slot, z); }

 private:
  NearbyHits* hits_;
};

}  // namespace cgemit

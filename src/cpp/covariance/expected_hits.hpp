// The hits that a track is expected to leave, found surface by surface while its reference is traced:
// clusters in every gap whose active area it crosses, and every cell that it passes through.
#pragma once

#include <vector>

#include "common/rng.hpp"
#include "covariance/covariance.hpp"
#include "covariance/given_errors.hpp"
#include "covariance/recorded.hpp"
#include "detector/strip_plane.hpp"
#include "detector/wires.hpp"
#include "matter/draws.hpp"
#include "motion/cells.hpp"
#include "motion/reach.hpp"
#include "motion/uniform.hpp"
#include "readout/cluster_errors.hpp"

namespace cgemit {

// An expected hit of each lane, kept for variants of the detector.
template <class T>
struct KeptHit {
  std::size_t step;
  View view;
  std::size_t layer;
  mask_of<T> there;     // lanes that have met it
  CellNumbers<T> cell;  // of a wire
  T edge;               // of a sheet, rad
  T variance, mean;     // mm^2, of a cluster: of this one, and of all with the same projected path
  T distance;           // mm, from a wire
};

template <class T>
class ExpectedHits {
 public:
  using Mask = mask_of<T>;

  ExpectedHits(const Detector& detector, const HitModel& model, const CovarianceInput& input,
               std::size_t first, Group<T>& group, std::vector<KeptHit<T>>& kept, bool again)
      : detector_(detector),
        model_(model),
        input_(input),
        first_(first),
        group_(group),
        kept_(kept),
        streams_(streams()),
        given_(model, gathered<T>([&](int i) { return input.tanl[track(i)]; })),
        delta_strips_(gathered<T>(
            [&](int i) { return model.delta_strips * input.charge[track(i)] * input.charge[track(i)]; })),
        again_(again),
        keeps_(!again && !input.variants.empty()),
        steps_(detector),
        cells_(detector, steps_) {
    group_.slots = {};
    for (GroupStep& step : group_.steps) step.first = step.last = 0;
    if (keeps_) kept_.clear();
  }
  ExpectedHits(const ExpectedHits&) = delete;  // `cells_` refers to `steps_`
  ExpectedHits& operator=(const ExpectedHits&) = delete;

  void reaches(GroupStep& step, const Slab& slab, const HelixPointOf<T>& at, const Mask& reached) {
    step.first = step.last = next_;
    if (const Mask missed = reached & slab.ends.miss(at.z); any(missed))
      reach_.miss(detector_, slab, at, missed, false);
    if (slab.gap < 0) return;
    const auto index = static_cast<std::size_t>(slab.gap);
    if (again_) return repeat(step, at);
    const MeasuringLayer& layer = detector_.layers[index];
    const Mask within = reached & reach_.parts & layer.ends.hold(at.z, -layer.dead_ends);
    if (!any(within)) return;
    const double dead = 0.5 * layer.dead_seam;
    const T phi = atan2(at.y, at.x);
    Mask there(false);
    T edge(0.0);
    std::array<std::int32_t, lanes_of<T>> channel{};
    for (int sheet = 0; sheet < layer.sheets; ++sheet) {
      const T begins(wrap_angle(layer.phi_first[static_cast<std::size_t>(sheet)]));
      const T along = along_sheet(layer, phi, begins);
      const Mask on =
          within & (along >= dead) & (along < layer.sheet_width() - dead) & !layer.between_ladders(along);
      edge = select(on, begins, edge);
      there = there | on;
      each_lane(on, [&](int i) { channel[static_cast<std::size_t>(i)] = sheet; });
    }
    if (!input_.efficiencies.empty()) there = there & is_efficient(index);
    if (!any(there)) return;
    for (const View view : {View::x, View::v})
      if (layer.has(view == View::x)) add_cluster(step, view, index, there, edge, phi, at.z).hit = channel;
  }

  CGEMIT_FLATTEN void passes(GroupStep& step, const HelixPointOf<T>& at, const Mask& alive) {
    step.first = step.last = next_;
    const std::size_t index = layer_++;
    if (again_) return repeat(step, at);
    const Mask outward = alive & reach_.chamber & at.is_outward();
    if (!any(outward)) return;
    CellRange<T, HelixPointOf<T>> range;
    const Mask found = cells_.find(index, at, outward, range);
    add_wires(step, index, found, range.first, range.last);
  }
  // The same for a recorded step.
  CGEMIT_FLATTEN void passes(GroupStep& step, const RecordedStep& recorded, const HelixPointOf<T>& at,
                             const T& azimuth) {
    step.first = step.last = next_;
    const std::size_t index = recorded.layer;
    if (again_) return repeat(step, at);
    T first(0.0), last(0.0);
    Mask found = recorded.cells.cells(azimuth * detector_.wires[index].per_radian, first, last);
    if (const Mask others = !found; any(others)) {
      CellRange<T, HelixPointOf<T>> range;
      found = found | cells_.find(index, at, others, range);
      first = select(others, range.first, first);
      last = select(others, range.last, last);
    }
    add_wires(step, index, found, first, last);
  }

  // Where its samples scatter, the trajectory turns in each slab by two angles with the standard deviation of
  // the slab's noise.
  void scatters(const GroupStep& step, const Slab& slab) {
    if (!any(group_.kinked)) return;
    Kink<T>& kink = group_.kinks[static_cast<std::size_t>(step.noise)];
    DrawsOf<T> draws(streams_, Purpose::scattering, slab.place);
    kink.aside = kink.sigma * normal_quantile(draws.next());
    kink.up = kink.sigma * normal_quantile(draws.next());
  }

  Mask on_wire(const Slot<T>& slot, const T& z) const {
    if (again_) return Mask(true);
    return detector_.wires[static_cast<std::size_t>(slot.layer)].ends.hold(z);
  }

  // The variance of a measurement that the reference has met. Tracks are anywhere in strips and cells,
  // whatever the design: a variant keeps the distances from wires, and a cluster's variance changes as the
  // mean over all positions of the strips.
  void measure(Slot<T>& slot, const Mask& met) {
    const auto number = static_cast<std::size_t>(&slot - group_.storage.data());
    if (slot.view == View::wire) {
      slot.variance = wire_variance(slot, again_ ? kept_[number].distance : abs(slot.predicted));
    } else if (again_) {
      slot.variance = kept_[number].variance * mean_error(slot) / kept_[number].mean;
    } else {
      slot.variance = cluster_error(slot);
    }
    if (!all(met))
      slot.variance = select(met, slot.variance, T(1.0));  // where the trace ended it is no number
    if (!keeps_) return;
    kept_[number].there = met;
    kept_[number].distance = abs(slot.predicted);
    if (slot.view == View::wire) return;
    kept_[number].variance = slot.variance;
    kept_[number].mean = mean_error(slot);
  }

 private:
  std::size_t track(int lane) const {
    return std::min(first_ + static_cast<std::size_t>(lane), input_.tracks() - 1);
  }
  std::size_t sample(int lane) const { return track(lane) % input_.samples; }

  static T along_sheet(const MeasuringLayer& layer, const T& phi, const T& edge) {
    const T turned = phi - edge;
    return layer.r_readout * select(turned < 0.0, turned + 2 * pi, turned);
  }

  Slot<T>& add_cluster(GroupStep& step, View view, std::size_t index, const Mask& there, const T& edge,
                       const T& phi, const T& z) {
    const MeasuringLayer& layer = detector_.layers[index];
    const T x = along_sheet(layer, phi, edge);
    Slot<T>& slot = add(step, view, index);
    slot.there = there;
    slot.edge = edge;
    // Tells the trace on which side of a seam the hit is.
    slot.drift = view == View::x ? x : x * layer.cos_stereo + (layer.z_ref() - z) * layer.sin_stereo;
    if (view == View::v) {  // uncorrelated with X, as in the fit
      slot.k = given_.k(index);
      slot.x = x;
    }
    if (keeps_)
      kept_.push_back({step_number(step), view, index, Mask(false), {}, edge, T(1.0), T(1.0), T(0.0)});
    return slot;
  }
  // The wires of cells from first to last.
  void add_wires(GroupStep& step, std::size_t index, Mask left, T first, const T& last) {
    const WireLayer& layer = detector_.wires[index];
    for (; any(left); left = left & (first <= last)) {
      const CellNumbers<T> cell = cell_numbers(layer, select(left, first, T(0.0)));
      Mask fired = layer.efficiency < 1 ? left & is_efficient(layer, cell) : left;
      if (!layer.masked.empty()) fired = fired & is_usable(layer, cell);
      first += T(1.0);
      if (any(fired)) add_wire(step, index, fired, cell);
    }
  }
  void add_wire(GroupStep& step, std::size_t index, const Mask& there, const CellNumbers<T>& cell) {
    Slot<T>& slot = add(step, View::wire, index);
    slot.there = there;
    slot.wire = cell_wires<T>(detector_.wires[index], cell);
    for (std::size_t i = 0; i < cell.size(); ++i) slot.hit[i] = static_cast<std::int32_t>(cell[i]);
    if (keeps_)
      kept_.push_back(
          {step_number(step), View::wire, index, Mask(false), cell, T(0.0), T(1.0), T(1.0), T(0.0)});
  }

  std::size_t step_number(const GroupStep& step) const {
    return static_cast<std::size_t>(&step - group_.steps.data());
  }
  // The kept hits of a step.
  void repeat(GroupStep& step, const HelixPointOf<T>& at) {
    while (static_cast<std::size_t>(next_) < kept_.size() &&
           kept_[static_cast<std::size_t>(next_)].step == step_number(step)) {
      const KeptHit<T>& kept = kept_[static_cast<std::size_t>(next_)];
      if (kept.view == View::wire)
        add_wire(step, kept.layer, kept.there, kept.cell);
      else
        add_cluster(step, kept.view, kept.layer, kept.there, kept.edge, atan2(at.y, at.x), at.z);
    }
  }

  Slot<T>& add(GroupStep& step, View view, std::size_t layer) {
    const auto used = static_cast<std::size_t>(next_);
    if (used == group_.storage.size()) group_.storage.resize(2 * used + 64);
    group_.slots = std::span(group_.storage).first(used + 1);
    step.last = ++next_;
    Slot<T>& slot = group_.storage[used];
    slot.k = 0.0;
    slot.variance = 1.0;
    slot.view = view;
    slot.layer = static_cast<std::int32_t>(layer);
    return slot;
  }

  Mask is_efficient(const WireLayer& layer, const CellNumbers<T>& cell) const {
    Mask fired(false);
    for (int i = 0; i < lanes_of<T>; ++i) {
      const auto wire = static_cast<std::uint32_t>(cell[static_cast<std::size_t>(i)]);
      const Stream stream(model_.seed, sample(i), 0);
      const Block words =
          stream.block(Purpose::drift_distance, static_cast<std::uint32_t>(layer.number) << 16 | wire);
      set_lane(fired, i, open_unit(words[1]) <= layer.efficiency);
    }
    return fired;
  }

  static Mask is_usable(const WireLayer& layer, const CellNumbers<T>& cell) {
    Mask usable(false);
    for (int i = 0; i < lanes_of<T>; ++i)
      set_lane(usable, i, !layer.is_masked(static_cast<std::size_t>(cell[static_cast<std::size_t>(i)])));
    return usable;
  }

  // Lanes whose crossing of a CGEM layer has clusters: X and V come from the same electrons.
  Mask is_efficient(std::size_t index) const {
    Mask fired(false);
    for (int i = 0; i < lanes_of<T>; ++i) {
      const Stream stream(model_.seed, sample(i), 0);
      const double drawn = open_unit(stream.block(Purpose::ionization, static_cast<std::uint32_t>(index))[0]);
      set_lane(fired, i, drawn <= input_.efficiencies[track(i) * detector_.layers.size() + index]);
    }
    return fired;
  }

  // A hit whose side is unknown is close to its wire a mixture of both, with the weights that the fit gives
  // them (`reconstruction/fit/measured.hpp`).
  T wire_variance(const Slot<T>& slot, const T& distance) const {
    const WireLayer& layer = detector_.wires[static_cast<std::size_t>(slot.layer)];
    const T sigma = drift_error(layer, distance), own = sigma * sigma;
    if (model_.sides_known) return own;
    const T weight = hyperbolic_tangent(distance * distance / own);
    return own + (1.0 - weight * weight) * distance * distance;
  }

  T cluster_error(const Slot<T>& slot) const {
    const auto index = static_cast<std::size_t>(slot.layer);
    if (given_.has(slot.view, index)) return given_error(slot, index);
    const bool is_x = slot.view == View::x;
    const std::size_t views = 2 * detector_.layers.size(), view = 2 * index + (is_x ? 0 : 1);
    const T phase = gathered<T>([&](int i) { return input_.phases[views * sample(i) + view]; });
    const auto [whole, part] = touched(slot.extent, pitch(slot));
    return error_of_size(slot, whole + select(phase < part, T(2.0), T(1.0)));
  }
  // The same, averaged over the positions of the strips.
  T mean_error(const Slot<T>& slot) const {
    const auto index = static_cast<std::size_t>(slot.layer);
    if (given_.has(slot.view, index)) return given_error(slot, index);
    const auto [whole, part] = touched(slot.extent, pitch(slot));
    return (1.0 - part) * error_of_size(slot, whole + 1.0) + part * error_of_size(slot, whole + 2.0);
  }
  T given_error(const Slot<T>& slot, std::size_t index) const {
    return given_.variance(slot.view, index) + inclined_variance(detector_.layers[index], slot.extent);
  }
  T error_of_size(const Slot<T>& slot, const T& size) const {
    return cluster_variance(size, slot.extent, pitch(slot), model_.least_width, delta_strips_);
  }
  double pitch(const Slot<T>& slot) const {
    const MeasuringLayer& layer = detector_.layers[static_cast<std::size_t>(slot.layer)];
    return slot.view == View::x ? layer.pitch_x : layer.pitch_v;
  }

  StreamOf<T> streams() const {
    const auto of_lane = [&](int i) { return Stream(model_.seed, sample(i), 0); };
    if constexpr (lanes_of<T> == 1) {
      return of_lane(0);
    } else {
      return [&]<int... i>(std::integer_sequence<int, i...>) {
        return StreamOf<T>({of_lane(i)...});
      }(std::make_integer_sequence<int, lanes_of<T>>());
    }
  }

  const Detector& detector_;
  const HitModel& model_;
  const CovarianceInput& input_;
  std::size_t first_;  // track in the first lane
  Group<T>& group_;
  std::vector<KeptHit<T>>& kept_;  // one per slot
  StreamOf<T> streams_;            // of the sample of each lane
  GivenErrors<T> given_;
  T delta_strips_;
  bool again_, keeps_;  // whether the kept hits are used, or made
  UniformMotionOf<T>
      steps_;  // to the next layer of wires; short, so that the field is as at the last surface
  CellFinder<T, UniformMotionOf<T>> cells_;
  Reach<T> reach_;
  std::size_t layer_ = 0;
  std::int32_t next_ = 0;
};

}  // namespace cgemit

// The hits that a track is expected to leave, found surface by surface while its reference is traced:
// clusters in every gap whose active area it crosses, and every cell that it passes through.
#pragma once

#include <bit>

#include "common/rng.hpp"
#include "covariance/covariance.hpp"
#include "detector/cluster_errors.hpp"
#include "detector/strip_plane.hpp"
#include "motion/cells.hpp"
#include "motion/uniform.hpp"

namespace cgemit {

template <class T>
class ExpectedHits {
 public:
  using Mask = mask_of<T>;

  ExpectedHits(const Detector& detector, const CovarianceSettings& settings, const CovarianceInput& input,
               std::size_t first, Group<T>& group)
      : detector_(detector),
        settings_(settings),
        input_(input),
        first_(first),
        group_(group),
        steps_(detector),
        cells_(detector, steps_) {
    group_.slots = {};
    for (GroupStep& step : group_.steps) step.first = step.last = 0;
  }
  ExpectedHits(const ExpectedHits&) = delete;  // `cells_` refers to `steps_`
  ExpectedHits& operator=(const ExpectedHits&) = delete;

  void reaches(GroupStep& step, const Slab& slab, const HelixPointOf<T>& at, const Mask& reached) {
    step.first = step.last = next_;
    if (slab.ends) inside_ = inside_ & ((!reached) | (abs(at.z) <= slab.half_length));
    if (slab.gap < 0) return;
    const auto index = static_cast<std::size_t>(slab.gap);
    const CgemLayer& layer = detector_.cgem[index];
    const Mask within = reached & inside_ & (abs(at.z) <= layer.half_length);
    if (!any(within)) return;
    const T phi = atan2(at.y, at.x);
    Mask there(false);
    T edge(0.0), x(0.0);
    for (int sheet = 0; sheet < layer.sheets; ++sheet) {
      const double begins = wrap_angle(layer.phi_first[static_cast<std::size_t>(sheet)]);
      const T turned = phi - begins;
      const T along = layer.r_readout * select(turned < 0.0, turned + 2 * pi, turned);
      const Mask on = within & (along < layer.sheet_width());
      edge = select(on, T(begins), edge);
      x = select(on, along, x);
      there = there | on;
    }
    if (!any(there)) return;
    const T v = x * layer.cos_stereo + (layer.z_ref() - at.z) * layer.sin_stereo;
    for (const View view : {View::x, View::v}) {
      Slot<T>& slot = add(step, view, index);
      slot.there = there;
      slot.edge = edge;
      slot.drift = view == View::x ? x : v;  // tells the trace on which side of a seam the hit is
    }
  }

  void passes(GroupStep& step, const HelixPointOf<T>& at, const Mask& alive) {
    step.first = step.last = next_;
    const std::size_t index = layer_++;
    const WireLayer& layer = detector_.wires[index];
    const Mask outward = alive & inside_ & (at.outward() > 0.0);
    if (!any(outward)) return;
    CellRange<T, HelixPointOf<T>> range;
    Mask left = cells_.find(index, at, outward, range);
    left = left & (abs(range.at_wires.z) <= layer.half_length);
    for (; any(left); left = left & (range.first <= range.last)) {
      const CellWires<T> cell(layer, select(left, range.first, T(0.0)));
      const Mask fired = layer.efficiency < 1 ? left & is_efficient(layer, cell) : left;
      range.first += T(1.0);
      if (!any(fired)) continue;
      Slot<T>& slot = add(step, View::wire, index);
      slot.there = fired;
      slot.wire = cell.wire;
    }
  }

  // The variance of a measurement that the reference has met.
  void measure(Slot<T>& slot) const {
    slot.variance = slot.view == View::wire ? wire_variance(slot) : cluster_error(slot);
  }

 private:
  std::size_t track(int lane) const {
    return std::min(first_ + static_cast<std::size_t>(lane), input_.tracks() - 1);
  }
  std::size_t sample(int lane) const { return track(lane) % input_.samples; }

  Slot<T>& add(GroupStep& step, View view, std::size_t layer) {
    const auto used = static_cast<std::size_t>(next_);
    if (used == group_.storage.size()) group_.storage.resize(2 * used + 64);
    group_.slots = std::span(group_.storage).first(used + 1);
    step.last = ++next_;
    Slot<T>& slot = group_.storage[used];
    empty(slot);
    slot.variance = 1.0;
    slot.residual = 0.0;
    slot.view = view;
    slot.layer = static_cast<std::int32_t>(layer);
    return slot;
  }

  Mask is_efficient(const WireLayer& layer, const CellWires<T>& cell) const {
    Mask fired(false);
    for (int i = 0; i < lanes_of<T>; ++i) {
      const auto wire = static_cast<std::uint32_t>(cell.number[static_cast<std::size_t>(i)]);
      const Stream stream(settings_.seed, sample(i), 0);
      const Block words =
          stream.block(Purpose::drift_distance, static_cast<std::uint32_t>(layer.number) << 16 | wire);
      set_lane(fired, i, open_unit(words[1]) <= layer.efficiency);
    }
    return fired;
  }

  // A hit whose side is unknown is close to its wire a mixture of both, with the weights that the fit gives
  // them (`fit/measured.hpp`).
  T wire_variance(const Slot<T>& slot) const {
    const WireLayer& layer = detector_.wires[static_cast<std::size_t>(slot.layer)];
    const T distance = abs(slot.predicted), sigma = layer.sigma + layer.sigma_slope * distance;
    const T own = sigma * sigma;
    if (settings_.sides_known) return own;
    const T weight = hyperbolic_tangent(distance * distance / own);
    return own + (1.0 - weight * weight) * distance * distance;
  }

  T cluster_error(const Slot<T>& slot) const {
    const auto index = static_cast<std::size_t>(slot.layer);
    const CgemLayer& layer = detector_.cgem[index];
    const bool is_x = slot.view == View::x;
    const double sigma = (is_x ? settings_.sigma_x : settings_.sigma_v)[index];
    if (sigma > 0) return T(sigma * sigma);
    const double pitch = is_x ? layer.pitch_x : layer.pitch_v;
    const std::size_t views = 2 * detector_.cgem.size(), view = 2 * index + (is_x ? 0 : 1);
    const T phase = gathered<T>([&](int i) { return input_.phases[views * sample(i) + view]; });
    const auto [whole, part] = touched(slot.extent, pitch);
    const T size = whole + 1.0 + select(phase < part, T(1.0), T(0.0));
    return cluster_variance(size, slot.extent, pitch, settings_.least_width, settings_.delta_strips);
  }

  const Detector& detector_;
  const CovarianceSettings& settings_;
  const CovarianceInput& input_;
  std::size_t first_;  // track in the first lane
  Group<T>& group_;
  UniformMotionOf<T>
      steps_;  // to the next layer of wires; short, so that the field is as at the last surface
  CellFinder<T, UniformMotionOf<T>> cells_;
  Mask inside_{true};  // not yet beyond an end
  std::size_t layer_ = 0;
  std::int32_t next_ = 0;
};

// The observer of a trace that asks for the expected hits.
template <class T>
class Expectation {
 public:
  static constexpr bool provides_hits = true;

  explicit Expectation(ExpectedHits<T>& hits) : hits_(&hits) {}

  template <class Motion>
  void reaches(GroupStep& step, const Slab& slab, const Motion& motion, const mask_of<T>& reached) {
    hits_->reaches(step, slab, motion.point(), reached);
  }
  template <class Motion>
  void passes(GroupStep& step, const Motion& motion, const mask_of<T>& alive) {
    hits_->passes(step, motion.point(), alive);
  }
  template <class Motion>
  void meets(Slot<T>& slot, const Motion&) {
    hits_->measure(slot);
  }
  template <class Motion>
  void arrives(const Slab&, const Motion&) {}
  template <class Noise>
  void crosses(const Slab&, const Noise&, const Kink<T>&) {}
  template <class Motion>
  void ends(const Motion&) {}

 private:
  ExpectedHits<T>* hits_;
};

}  // namespace cgemit

// Writes the result of a lane into the rows of its track.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "kalman/filter.hpp"
#include "reconstruction/fit/breaks.hpp"
#include "reconstruction/fit/fit.hpp"

namespace cgemit {

// The output rows of the track in a lane and of its hits.
using FitLane = FitOutput;

// The linearisation point of an iteration, and the covariance of its prior.
template <class T>
struct LinearisedAbout {
  PerigeeOf<T> helix;
  std::vector<Kink<T>> kinks;
  Symmetric<T> prior;
};

template <class T>
void write_covariance(const Symmetric<T>& c, int i, std::array<std::array<double, 5>, 5>& out) {
  for (int k = 0; k < parameters; ++k) {
    for (int m = 0; m < parameters; ++m)
      out[static_cast<std::size_t>(k)][static_cast<std::size_t>(m)] = lane(c(k, m), i);
  }
}

// Parameters as in the BES3 files.
template <class T>
void write_helix(FitRow& row, const PerigeeOf<T>& helix, int i, int iterations) {
  row.helix = {lane(helix.d, i), wrap_angle(lane(helix.psi, i) - 0.5 * pi), lane(helix.kappa, i),
               lane(helix.z0, i), lane(helix.tanl, i)};
  row.iterations = iterations;
}

template <class T>
void write_state(FitRow& row, const FilteredState<T>& state, int i, FitStatus status) {
  row.status = status;
  row.chi2 = lane(state.chi2, i);
  write_covariance(state.c, i, row.covariance);
}

template <class T>
void write_density(std::span<const FitLane> lanes, const Breaks<T>& breaks, mask_of<T> who) {
  const std::array<T, 5> limits = breaks.limits();
  const MomentumDensity<T>& density = breaks.density();
  for (std::size_t k = 0; k < lanes.size(); ++k) {
    const int i = static_cast<int>(k);
    if (!lane(who, i)) continue;
    FitRow& row = *lanes[k].rows;
    for (std::size_t n = 0; n < limits.size(); ++n) row.limits[n] = lane(limits[n], i);
    row.radiated = lane(breaks.seen(), i);
    row.radius_radiated = lane(breaks.radius(), i);
    if (lanes[k].densities == nullptr) continue;
    DensityRow& to = *lanes[k].densities;
    to = {};
    for (std::size_t n = 0; n < density.n; ++n) {
      to.weight[n] = lane(density.weight[n], i);
      to.mean[n] = lane(density.mean[n], i);
      to.sigma[n] = lane(density.sigma[n], i);
    }
  }
}

// Counts the hits of each track. One that the track does not meet is left out, too.
template <class T>
void count_hits(std::span<const FitLane> lanes, const Group<T>& group, mask_of<T> who) {
  std::array<int, static_cast<std::size_t>(lanes_of<T>)> hits{};
  T wires(0.0), clusters(0.0);
  for (const Slot<T>& slot : group.slots) {
    for (std::size_t k = 0; k < hits.size(); ++k) hits[k] += slot.hit[k] >= 0;
    T& used = slot.view == View::wire ? wires : clusters;
    used += select(slot.used, T(1.0), T(0.0));
  }
  for (std::size_t k = 0; k < lanes.size(); ++k) {
    const int i = static_cast<int>(k);
    if (!lane(who, i)) continue;
    FitRow& row = *lanes[k].rows;
    row.wires = static_cast<int>(lane(wires, i));
    row.clusters = static_cast<int>(lane(clusters, i));
    row.outliers = hits[k] - row.wires - row.clusters;
  }
}

// A hit that the track does not meet has no residual.
template <class T>
void write_hit(const FitLane& to, const Slot<T>& slot, std::size_t k) {
  const int i = static_cast<int>(k);
  if (!lane(slot.met, i)) return;
  const double weight = lane(slot.weight, i);
  to.hits[slot.hit[k]] = {lane(slot.unbiased, i), std::sqrt(lane(slot.unbiased_variance, i)),
                          static_cast<std::int8_t>(weight > 0 ? 1 : (weight < 0 ? -1 : 0)),
                          static_cast<std::uint8_t>(lane(slot.used, i))};
  if (to.measured != nullptr) to.measured[slot.hit[k]] = {lane(slot.value, i), lane(slot.variance, i)};
}

template <class T>
void write_hits(std::span<const FitLane> lanes, const Group<T>& group, mask_of<T> who) {
  count_hits(lanes, group, who);
  if (lanes.front().hits == nullptr) return;
  for (const Slot<T>& slot : group.slots) {
    for (std::size_t k = 0; k < lanes.size(); ++k)
      if (slot.hit[k] >= 0 && lane(who, static_cast<int>(k))) write_hit(lanes[k], slot, k);
  }
}

template <class T>
void write_reference(const FitLane& to, const LinearisedAbout<T>& about, const Group<T>& group, int i,
                     std::size_t slabs) {
  const PerigeeOf<T>& helix = about.helix;
  to.last->reference = {lane(helix.d, i), lane(helix.psi, i), lane(helix.kappa, i), lane(helix.z0, i),
                        lane(helix.tanl, i)};
  write_covariance(about.prior, i, to.last->prior);
  std::fill_n(to.kinks, slabs, KinkRow{});
  for (const GroupStep& step : group.steps) {
    if (!step.is_slab || !lane(group.kinked, i)) continue;
    const Kink<T>& kink = about.kinks[static_cast<std::size_t>(step.noise)];
    to.kinks[step.slab].angles = {lane(kink.aside, i), lane(kink.up, i)};
  }
}

}  // namespace cgemit

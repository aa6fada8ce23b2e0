// The exact split of the covariance by its sources.
//
// The estimate at the origin is linear in the errors of the measurements and in the noise of the scatterers.
// Its error is sum_k u_k e_k with independent e_k of variance 1, so that the covariance is sum_k u_k u_k^T.
// The u_k follow from the gains of the filter: with L = 1 behind the innermost update, going outward,
//   measurement:  u = L K sigma,  then L <- L - L K h^T;     noise vector g:  u = L g,
// and L (prior) L^T remains. The sum is the covariance for any gains K (Joseph's form), so it has no rounding
// error of differences. The entries that the budget does not split are those of the filter.
#pragma once

#include "covariance/covariance.hpp"

namespace cgemit {

// The part of one source: of the variances as in `BudgetTerm`.
template <class T>
using TermOf = std::array<T, budget_entries>;

template <class T>
class Budget {
 public:
  // `terms`: sums to which the parts are added, or null.
  Budget(const Detector& detector, const Group<T>& group, TermOf<T>* terms, const mask_of<T>& who)
      : detector_(detector), group_(group), names_(detector), terms_(terms), who_(who), everyone_(all(who)) {}

  // After the filter. Replaces the entries of its covariance that are split by their sums.
  CGEMIT_FLATTEN void split(const std::array<double, 5>& prior_sigma, Symmetric<T>& covariance) const {
    Gains l;
    TermOf<T> total = nothing();
    unroll<parameters>([&](auto k) {
      l[k] = Five<T>::zero();
      l[k][k] = 1.0;
    });
    for (const GroupStep& step : group_.steps) {
      for (std::int32_t s = step.first; s < step.last; ++s)
        measure(group_.slots[static_cast<std::size_t>(s)], l, total);
      if (!step.is_slab || !any(group_.ahead[static_cast<std::size_t>(step.noise)])) continue;
      if (!group_.dense)
        scatter(step, group_.noise[static_cast<std::size_t>(step.noise)], l, total);
      else
        scatter(step, group_.dense_noise[static_cast<std::size_t>(step.noise)], l, total);
    }
    TermOf<T> prior = nothing();
    unroll<parameters>([&](auto k) { count(prior, T(prior_sigma[k]) * l[k]); });
    add(prior, names_.prior(), total);
    unroll<parameters>([&](auto i) { covariance(i, i) = total[i]; });
    covariance(2, 4) = total[5];
  }

 private:
  using Gains = std::array<Five<T>, parameters>;  // L, column by column

  static TermOf<T> nothing() {
    TermOf<T> none;
    none.fill(T(0.0));
    return none;
  }

  CGEMIT_FLATTEN void measure(const Slot<T>& slot, Gains& l, TermOf<T>& total) const {
    const Five<T> u = slot.inverse * along(l, slot.ch.v);
    unroll<parameters>([&](auto k) { l[k] = l[k] - slot.row[k] * u; });
    const auto layer = static_cast<std::size_t>(slot.layer);
    add(scaled(slot.variance, squares(u)),
        slot.view == View::wire ? names_.wire(layer) : names_.cluster(layer, slot.view), total);
  }

  template <class Noise>
  CGEMIT_FLATTEN void scatter(const GroupStep& step, const Noise& noise, const Gains& l,
                              TermOf<T>& total) const {
    const auto index = static_cast<std::size_t>(step.slab);
    add(squares(along(l, noise.straggling)), names_.straggling(index), total);
    TermOf<T> angles = squares(along(l, noise.turn));
    count(angles, along(l, noise.dip));
    if (detector_.slabs[index].shifts) {
      count(angles, along(l, noise.shift_across));
      count(angles, along(l, noise.shift_along));
    }
    add(angles, names_.scattering(index), total);
  }

  // L g, also for the zeros that `SlabNoise` leaves out.
  static Five<T> along(const Gains& l, const Five<T>& g) { return along(l, g.v); }
  static Five<T> along(const Gains& l, const std::array<T, 5>& g) {
    return g[0] * l[0] + g[1] * l[1] + g[2] * l[2] + g[3] * l[3] + g[4] * l[4];
  }
  static Five<T> along(const Gains& l, const std::array<T, 4>& g) {
    return g[0] * l[0] + g[1] * l[1] + g[2] * l[2] + g[3] * l[3];
  }
  static Five<T> along(const Gains& l, const std::array<T, 3>& g) {
    return g[0] * l[0] + g[1] * l[1] + g[2] * l[3];
  }

  static TermOf<T> squares(const Five<T>& u) {
    return {u[0] * u[0], u[1] * u[1], u[2] * u[2], u[3] * u[3], u[4] * u[4], u[2] * u[4]};
  }
  static TermOf<T> scaled(const T& by, TermOf<T> part) {
    unroll<budget_entries>([&](auto e) { part[e] *= by; });
    return part;
  }
  static void count(TermOf<T>& sum, const Five<T>& u) {
    const TermOf<T> part = squares(u);
    unroll<budget_entries>([&](auto e) { sum[e] += part[e]; });
  }

  void add(const TermOf<T>& part, std::size_t term, TermOf<T>& total) const {
    unroll<budget_entries>([&](auto e) { total[e] += part[e]; });
    if (terms_ == nullptr) return;
    TermOf<T>& to = terms_[term];
    if (everyone_) {
      unroll<budget_entries>([&](auto e) { to[e] += part[e]; });
    } else {
      unroll<budget_entries>([&](auto e) { to[e] += select(who_, part[e], T(0.0)); });
    }
  }

  const Detector& detector_;
  const Group<T>& group_;
  BudgetTerms names_;
  TermOf<T>* terms_;
  mask_of<T> who_;
  bool everyone_;
};

}  // namespace cgemit

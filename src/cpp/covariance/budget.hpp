// The exact split of the covariance by its sources.
//
// The estimate at the origin is linear in the errors of the measurements and in the noise of the scatterers.
// Its error is sum_k u_k e_k with independent e_k of variance 1, so that the covariance is sum_k u_k u_k^T.
// The u_k follow from the gains of the filter: with L = 1 behind the innermost update, going outward,
//   measurement:  u = L K sigma,  then L <- L (1 - K h^T);     noise vector g:  u = L g,
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
  Budget(const Detector& detector, Group<T>& group, TermOf<T>* terms, const mask_of<T>& who)
      : detector_(detector), group_(group), names_(detector), terms_(terms), who_(who), everyone_(all(who)) {
    total_.fill(T(0.0));
    unroll<parameters>([&](auto i) {
      rows_[i] = Five<T>::zero();
      rows_[i][i] = 1.0;
    });
  }

  // After the filter. Replaces the entries of its covariance that are split by their sums.
  CGEMIT_FLATTEN void split(const std::array<double, 5>& prior_sigma, Symmetric<T>& covariance) {
    for (const GroupStep& step : group_.steps) {
      for (std::int32_t s = step.first; s < step.last; ++s)
        measure(group_.slots[static_cast<std::size_t>(s)]);
      if (!step.is_slab) continue;
      if (group_.dense_noise.empty())
        scatter(step, group_.noise[static_cast<std::size_t>(step.noise)]);
      else
        scatter(step, group_.dense_noise[static_cast<std::size_t>(step.noise)]);
    }
    unroll<parameters>([&](auto k) {
      Five<T> u;
      unroll<parameters>([&](auto i) { u[i] = rows_[i][k] * prior_sigma[k]; });
      add(u, names_.prior());
    });
    unroll<parameters>([&](auto i) { covariance(i, i) = total_[i]; });
    covariance(2, 4) = total_[5];
  }

 private:
  CGEMIT_FLATTEN void measure(const Slot<T>& slot) {
    const T sigma = sqrt(slot.variance);
    Five<T> u;
    unroll<parameters>([&](auto i) { u[i] = slot.inverse * dot(rows_[i], slot.ch); });
    unroll<parameters>([&](auto i) { rows_[i] = rows_[i] - u[i] * slot.row; });
    const auto layer = static_cast<std::size_t>(slot.layer);
    add(sigma * u, slot.view == View::wire ? names_.wire(layer) : names_.cluster(layer, slot.view));
  }

  template <class Noise>
  CGEMIT_FLATTEN void scatter(const GroupStep& step, const Noise& noise) {
    const auto index = static_cast<std::size_t>(step.slab);
    const auto seen = [&](const auto& g) {
      Five<T> u;
      unroll<parameters>([&](auto i) { u[i] = along(rows_[i], g); });
      return u;
    };
    add(seen(noise.straggling), names_.straggling(index));
    add(seen(noise.turn), names_.scattering(index));
    add(seen(noise.dip), names_.scattering(index));
    if (!detector_.slabs[index].shifts) return;
    add(seen(noise.shift_across), names_.scattering(index));
    add(seen(noise.shift_along), names_.scattering(index));
  }

  // Noise vectors with the zeros that `SlabNoise` leaves out.
  static T along(const Five<T>& row, const Five<T>& g) { return dot(row, g); }
  static T along(const Five<T>& row, const std::array<T, 4>& g) {
    return row[0] * g[0] + row[1] * g[1] + row[2] * g[2] + row[3] * g[3];
  }
  static T along(const Five<T>& row, const std::array<T, 3>& g) {
    return row[0] * g[0] + row[1] * g[1] + row[3] * g[2];
  }

  void add(const Five<T>& u, std::size_t term) {
    TermOf<T> part{u[0] * u[0], u[1] * u[1], u[2] * u[2], u[3] * u[3], u[4] * u[4], u[2] * u[4]};
    unroll<budget_entries>([&](auto e) { total_[e] += part[e]; });
    if (terms_ == nullptr) return;
    TermOf<T>& to = terms_[term];
    if (everyone_) {
      unroll<budget_entries>([&](auto e) { to[e] += part[e]; });
    } else {
      unroll<budget_entries>([&](auto e) { to[e] += select(who_, part[e], T(0.0)); });
    }
  }

  const Detector& detector_;
  Group<T>& group_;
  BudgetTerms names_;
  TermOf<T>* terms_;
  mask_of<T> who_;
  bool everyone_;
  std::array<Five<T>, parameters> rows_;  // of L
  TermOf<T> total_;
};

}  // namespace cgemit

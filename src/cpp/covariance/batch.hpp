// Covariances of many tracks, one per lane.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "covariance/budget.hpp"
#include "covariance/expected_hits.hpp"
#include "kalman/field_reference.hpp"
#include "kalman/filter.hpp"
#include "kalman/tracer.hpp"

namespace cgemit {

template <class T>
class CovarianceBatch {
 public:
  CovarianceBatch(const Detector& detector, const CovarianceInput& input, const HitModel& model,
                  const CovarianceOutput& output)
      : detector_(detector), input_(input), model_(model), out_(output), names_(detector) {
    std::int32_t slabs = 0;
    for (const Surface& surface : detector.surfaces)
      group_.steps.push_back(
          {surface.is_slab, surface.is_slab ? surface.index : -1, surface.is_slab ? slabs++ : -1, 0, 0});
    const auto n = static_cast<std::size_t>(slabs);
    group_.noise.resize(n);
    group_.dense_noise.resize(detector.field.is_uniform() ? 0 : n);
    group_.kinks.resize(n);
    if (out_.budget != nullptr) terms_.resize(names_.size());
  }

  void run() {
    for (std::size_t first = 0; first < input_.tracks();) {
      std::size_t n = 1;
      while (n < width && first + n < input_.tracks() && kind(first + n) == kind(first)) ++n;
      run_group(first, n);
      first += n;
    }
  }

 private:
  static constexpr std::size_t width = lanes_of<T>;

  Projectile kind(std::size_t track) const { return projectile_of(input_.mass[track], input_.kappa[track]); }
  std::size_t point(std::size_t track) const { return track / input_.samples; }

  void run_group(std::size_t first, std::size_t n) {
    const auto column = [&](std::span<const double> values) {
      return gathered<T>(
          [&](int i) { return values[std::min(first + static_cast<std::size_t>(i), first + n - 1)]; });
    };
    const PerigeeOf<T> start{T(0.0), column(input_.psi), column(input_.kappa), T(0.0), column(input_.tanl)};
    const T mass = column(input_.mass);
    group_.kinked = column(input_.scatters) != 0.0;
    compute(detector_, first, start, mass, false, terms_.data(), &out_.rows[first], n);
    if (out_.hits != nullptr) write_hits(n);
    for (std::size_t v = 0; v < input_.variants.size(); ++v) {
      CovarianceRow* rows = &out_.rows[(v + 1) * input_.tracks() + first];
      compute(*input_.variants[v], first, start, mass, true, nullptr, rows, n);
    }
    // The sums stay in lanes as long as all lanes belong to one point and the next group fills all of them.
    const std::size_t next_end = first + n + width;
    const bool next_is_same =
        n == width && next_end <= input_.tracks() && point(first) == point(next_end - 1);
    if (out_.budget != nullptr && !next_is_same) flush(first, n);
  }

  // Traces and filters n tracks and writes their rows. `again`: with the hits of the first detector.
  void compute(const Detector& detector, std::size_t first, const PerigeeOf<T>& start, const T& mass,
               bool again, TermOf<T>* terms, CovarianceRow* rows, std::size_t n) {
    ExpectedHits<T> hits(detector, model_, input_, first, group_, kept_, again);
    // Whether hits lie beyond a slab is not known before.
    group_.ahead.assign(group_.noise.size(), mask_of<T>(true));
    trace(detector, start, mass, kind(first), Expectation<T>(hits));
    for (Slot<T>& slot : group_.slots) slot.used = slot.met;
    Five<T> prior;
    unroll<parameters>([&](auto i) { prior[i] = model_.prior_sigma[i] * model_.prior_sigma[i]; });
    FilteredState<T> state = filter<false>(detector, group_, Symmetric<T>::diagonal(prior));
    const mask_of<T> valid = sound(state) & positive_definite(state.c);
    mask_of<T> ok(false);
    T clusters(0.0), wires(0.0);
    for (const Slot<T>& slot : group_.slots)
      (slot.view == View::wire ? wires : clusters) += select(slot.met, T(1.0), T(0.0));
    for (std::size_t k = 0; k < n; ++k) {
      rows[k].clusters = static_cast<std::int32_t>(lane(clusters, static_cast<int>(k)));
      rows[k].wires = static_cast<std::int32_t>(lane(wires, static_cast<int>(k)));
      rows[k].status = status(static_cast<int>(k), valid);
      set_lane(ok, static_cast<int>(k), rows[k].status == FitStatus::ok);
    }
    Budget<T>(detector, group_, terms, ok).split(model_.prior_sigma, state.c);
    write(state.c, rows, n);
  }

  void trace(const Detector& detector, const PerigeeOf<T>& start, const T& mass, Projectile projectile,
             Expectation<T> hits) {
    const mask_of<T> all(true);
    if (detector.field.is_uniform()) {
      Tracer<T, HelixMotion<T>, Expectation<T>>(detector, start, mass, projectile, group_, hits).run(all);
    } else {
      Tracer<T, FieldReference<T>, Expectation<T>>(detector, start, mass, projectile, group_, hits).run(all);
    }
  }

  FitStatus status(int i, const mask_of<T>& valid) const {
    if (group_.reached[static_cast<std::size_t>(i)] <= parameters) {
      if (lane(group_.left, i)) return FitStatus::left_field;
      return lane(group_.stopped, i) ? FitStatus::stopped : FitStatus::too_few_hits;
    }
    return lane(valid, i) ? FitStatus::ok : FitStatus::not_positive_definite;
  }

  static void write(const Symmetric<T>& covariance, CovarianceRow* rows, std::size_t n) {
    for (std::size_t k = 0; k < n; ++k)
      for (std::size_t e = 0; e < covariance_entries; ++e)
        rows[k].covariance[e] =
            rows[k].status == FitStatus::ok ? lane(covariance.v[e], static_cast<int>(k)) : std::nan("");
  }

  void write_hits(std::size_t n) {
    for (int k = 0; k < static_cast<int>(n); ++k)
      for (const Slot<T>& slot : group_.slots)
        if (lane(slot.met, k))
          out_.hits->push_back({slot.view, slot.layer, slot.hit[static_cast<std::size_t>(k)],
                                lane(slot.predicted, k), lane(slot.variance, k)});
  }

  // Adds the sums of the lanes to the budgets of their points.
  void flush(std::size_t first, std::size_t n) {
    for (std::size_t term = 0; term < terms_.size(); ++term) {
      for (std::size_t e = 0; e < budget_entries; ++e) {
        for (std::size_t k = 0; k < n; ++k)
          out_.budget[point(first + k) * terms_.size() + term][e] +=
              lane(terms_[term][e], static_cast<int>(k));
        terms_[term][e] = 0.0;
      }
    }
  }

  const Detector& detector_;
  const CovarianceInput& input_;
  const HitModel& model_;
  const CovarianceOutput& out_;
  BudgetTerms names_;
  Group<T> group_;
  std::vector<KeptHit<T>> kept_;
  std::vector<TermOf<T>> terms_;  // sums of the present lanes; empty without budget
};

}  // namespace cgemit

// Covariances of many tracks, one per lane.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "covariance/budget.hpp"
#include "covariance/expectation.hpp"
#include "kalman/field_reference.hpp"
#include "kalman/filter.hpp"
#include "kalman/tracer.hpp"

namespace cgemit {

template <class T>
class CovarianceBatch {
 public:
  CovarianceBatch(const Detector& detector, const CovarianceInput& input, const HitModel& model,
                  const CovarianceOutput& output)
      : detector_(detector),
        input_(input),
        model_(model),
        out_(output),
        names_(detector),
        group_(empty_group<T>(detector)) {
    if (out_.budget != nullptr) terms_.resize(names_.size());
  }

  void run() {
    for (std::size_t first = 0; first < input_.tracks() && !input_.interrupted();) {
      std::size_t n = 1;
      if (first % input_.samples == 0 && turned_only(first) && run_point(first)) {
        n = input_.samples;
      } else {
        const std::size_t end = std::min(input_.tracks(), next_turned(first));
        while (n < width && first + n < end && kind(first + n) == kind(first)) ++n;
        run_group(first, n);
      }
      first += n;
    }
  }

 private:
  static constexpr std::size_t width = lanes_of<T>;
  using UniformTracer = Tracer<T, HelixMotion<T>, Expectation<T>>;

  Projectile kind(std::size_t track) const { return projectile_of(input_.mass[track], input_.kappa[track]); }
  std::size_t point(std::size_t track) const { return track / input_.samples; }

  // Whether the tracks of a point, of which this is the first, are the same but for a turn about the beam
  // line, and enough to record one of them.
  bool turned_only(std::size_t first) const {
    if (!input_.d.empty() || !detector_.field.is_uniform() ||
        input_.samples < std::max<std::size_t>(width, 2))
      return false;
    for (std::size_t i = first; i < first + input_.samples; ++i)
      if (input_.kappa[i] != input_.kappa[first] || input_.tanl[i] != input_.tanl[first] ||
          input_.mass[i] != input_.mass[first] || input_.charge[i] != input_.charge[first] ||
          input_.scatters[i] != 0)
        return false;
    return true;
  }
  // The next point that `run_point` may take.
  std::size_t next_turned(std::size_t track) const {
    const std::size_t samples = input_.samples;
    std::size_t next = (track / samples + 1) * samples;
    while (next < track + width && next < input_.tracks() && !turned_only(next)) next += samples;
    return next;
  }

  // Computes all tracks of a point from one that is recorded for each detector; false if they do not go
  // straight on in all of them.
  bool run_point(std::size_t first) {
    const Species species = species_of(input_.mass[first], input_.charge[first], input_.kappa[first]);
    const Perigee start{0, 0, input_.kappa[first], 0, input_.tanl[first]};
    std::vector<RecordedTrack> recorded;
    recorded.reserve(1 + input_.variants.size());
    for (std::size_t v = 0; v <= input_.variants.size(); ++v) {
      recorded.emplace_back(detector_of(v), empty_group<double>(detector_of(v)), start, species);
      if (!recorded.back().straight_on()) return false;
    }
    const std::size_t end = first + input_.samples;
    std::vector<std::vector<KeptHit<T>>> kept((input_.samples + width - 1) / width);
    for (std::size_t v = 0; v < recorded.size(); ++v) {
      recorded[v].give(group_);
      UniformTracer tracer(detector_of(v), perigee(first, 1), species_at(first, 1), group_, Expectation<T>());
      for (std::size_t i = first; i < end; i += width) {
        const std::size_t n = std::min(width, end - i);
        ExpectedHits<T> hits(detector_of(v), model_, input_, i, group_, kept[(i - first) / width], v > 0);
        tracer.observe(Expectation<T>(hits));
        const T psi = column(input_.psi, i, n);
        tracer.replay(recorded[v].steps(), sine_cosine(psi), psi);
        finish(detector_of(v), v, i, n);
        if (v == 0 && out_.hits != nullptr) write_hits(n);
      }
      if (v + 1 == recorded.size()) flush(first, width);
    }
    return true;
  }

  void run_group(std::size_t first, std::size_t n) {
    group_.kinked = column(input_.scatters, first, n) != 0.0;
    for (std::size_t v = 0; v <= input_.variants.size(); ++v) {
      ExpectedHits<T> hits(detector_of(v), model_, input_, first, group_, kept_, v > 0);
      // Whether hits lie beyond a slab is not known before.
      group_.ahead.assign(group_.noise.size(), mask_of<T>(true));
      trace(detector_of(v), first, n, Expectation<T>(hits));
      finish(detector_of(v), v, first, n);
      if (v == 0 && out_.hits != nullptr) write_hits(n);
    }
    // The sums stay in lanes as long as all lanes belong to one point and the next group fills all of them.
    const std::size_t next_end = first + n + width;
    const bool next_is_same =
        n == width && next_end <= input_.tracks() && point(first) == point(next_end - 1);
    if (!next_is_same) flush(first, n);
  }

  // The detector, or one of its variants.
  const Detector& detector_of(std::size_t v) const { return v == 0 ? detector_ : *input_.variants[v - 1]; }

  T column(std::span<const double> values, std::size_t first, std::size_t n) const {
    return gathered<T>(
        [&](int i) { return values[std::min(first + static_cast<std::size_t>(i), first + n - 1)]; });
  }
  PerigeeOf<T> perigee(std::size_t first, std::size_t n) const {
    const bool beside = !input_.d.empty();
    return {beside ? column(input_.d, first, n) : T(0.0), column(input_.psi, first, n),
            column(input_.kappa, first, n), beside ? column(input_.z0, first, n) : T(0.0),
            column(input_.tanl, first, n)};
  }

  SpeciesOf<T> species_at(std::size_t first, std::size_t n) const {
    return {column(input_.mass, first, n), column(input_.charge, first, n), kind(first)};
  }

  // Filters n tracks whose hits are known, and writes their rows.
  void finish(const Detector& detector, std::size_t variant, std::size_t first, std::size_t n) {
    CovarianceRow* rows = &out_.rows[variant * input_.tracks() + first];
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
    Budget<T>(detector, group_, variant == input_.variants.size() ? terms_.data() : nullptr, ok)
        .split(model_.prior_sigma, state.c);
    write(state.c, rows, n);
  }

  void trace(const Detector& detector, std::size_t first, std::size_t n, Expectation<T> hits) {
    const PerigeeOf<T> start = perigee(first, n);
    const SpeciesOf<T> species = species_at(first, n);
    const mask_of<T> all(true);
    if (detector.field.is_uniform()) {
      UniformTracer(detector, start, species, group_, hits).run(all);
    } else {
      Tracer<T, FieldReference<T>, Expectation<T>>(detector, start, species, group_, hits).run(all);
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

  std::int32_t number(std::int32_t layer) const {
    return detector_.wires[static_cast<std::size_t>(layer)].number;
  }
  void write_hits(std::size_t n) {
    for (int k = 0; k < static_cast<int>(n); ++k)
      for (const Slot<T>& slot : group_.slots)
        if (lane(slot.met, k))
          out_.hits->push_back({.view = slot.view,
                                .layer = slot.view == View::wire ? number(slot.layer) : slot.layer,
                                .channel = slot.hit[static_cast<std::size_t>(k)],
                                .value = lane(slot.predicted, k),
                                .variance = lane(slot.variance, k),
                                .k = lane(slot.k, k),
                                .x = lane(slot.x, k)});
  }

  // Adds the sums of the lanes to the budgets of their points: of n tracks, or of lanes of one point.
  void flush(std::size_t first, std::size_t n) {
    if (terms_.empty()) return;
    std::array<BudgetTerm*, width> to{};
    for (std::size_t k = 0; k < n; ++k) to[k] = out_.budget + point(first + k) * terms_.size();
    for (std::size_t term = 0; term < terms_.size(); ++term) {
      for (std::size_t k = 0; k < n; ++k)
        for (std::size_t e = 0; e < budget_entries; ++e)
          to[k][term][e] += lane(terms_[term][e], static_cast<int>(k));
      terms_[term].fill(T(0.0));
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

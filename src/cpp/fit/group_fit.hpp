// The fit of a group of tracks, one per lane.
#pragma once

#include <algorithm>
#include <cmath>

#include "fit/first_guess.hpp"
#include "fit/measured.hpp"
#include "fit/outliers.hpp"
#include "kalman/field_reference.hpp"
#include "kalman/filter.hpp"
#include "kalman/tracer.hpp"

namespace cgemit {

// A track in a lane: where its row and those of its hits go.
using FitLane = FitOutput;

template <class T>
class GroupFit {
 public:
  GroupFit(const Detector& detector, const FitSettings& settings, Group<T>& group)
      : detector_(detector), settings_(settings), group_(group) {}

  // From `start`, which most hits miss by `spread` (mm). `wires_first`: sides that are open settle among the
  // wires before the clusters join. `kinks`: slow tracks get them.
  void run(const PerigeeOf<T>& start, T spread, T mass, Projectile projectile, std::span<const FitLane> lanes,
           bool wires_first, bool kinks) {
    helix_ = start;
    spread_ = spread;
    passed_ = T(0.0);
    lanes_ = lanes;
    open_ = has_open_sides();
    wires_only_ = wires_first & open_;
    kinks_ = kinks;
    chi2_ = T(0.0);
    active_ = mask_of<T>(false);
    for (std::size_t k = 0; k < lanes.size(); ++k) set_lane(active_, static_cast<int>(k), true);
    Five<T> prior;
    unroll<parameters>([&](auto i) {
      const double sigma = settings_.prior_sigma[static_cast<std::size_t>(i)];
      prior[i] = sigma * sigma;
    });
    known_ = prior;
    for (iteration_ = 0; iteration_ < settings_.max_iterations && any(active_); ++iteration_)
      iterate(prior, mass, projectile);
  }

  // Whether slow tracks may get kinks at all.
  static bool gives_kinks(const FitSettings& settings) {
    return settings.kinks && settings.max_iterations > kink_iterations;
  }

 private:
  static constexpr int patient_iterations = 6;
  static constexpr int impatient_iterations = 4;    // from here on outliers may be why a fit does not settle
  static constexpr int last_return = 8;             // from this iteration on an outlier stays one
  static constexpr int kink_iterations = 4;         // that have to be left for kinks to settle
  static constexpr double least_scattering = 5e-5;  // rad^2; what is less is linear

  void iterate(const Five<T>& prior, T mass, Projectile projectile) {
    const bool last = iteration_ + 1 == settings_.max_iterations;
    if (iteration_ > patient_iterations) give_up_hits();
    trace(mass, projectile);
    mask_of<T> works = active_;
    if (any(group_.stopped)) works = works & !speed_up(last);
    passed_ = select(works, helix_.kappa, passed_);
    const mask_of<T> few = too_few(), hopeless(last || iteration_ >= patient_iterations);
    works = works & !finish(works & group_.left & (few | hopeless), FitStatus::left_field);
    works = works & !finish(works & few, FitStatus::does_not_reach);
    if (!any(works)) return;
    // Radiation leaves electrons where no first helix expects them.
    if (iteration_ == 0 && projectile < Projectile::electron)
      first_guess(group_, helix_, mass, spread_, works, settings_.outlier_pull > 0);
    if (settings_.outlier_pull > 0) keep_enough(group_, works);
    fill_slots(group_, detector_, settings_, wires_only_);
    prior_ = beginning(prior);
    Estimate<T> estimate = filter(detector_, group_, prior_);
    works = works & !finish(works & !(positive_definite(estimate.c) & sound(estimate)),
                            FitStatus::not_positive_definite);
    T moved(0.0);
    unroll<parameters>([&](auto i) {
      moved = larger(moved, estimate.x[i] * estimate.x[i] / estimate.c(i, i));
      known_[i] = select(works, estimate.c(i, i), known_[i]);
    });
    reference_ = helix_;
    if (any(group_.kinked)) reference_kinks_ = group_.kinks;
    move(estimate.x, works);
    // Smoothing is for weights, outliers, kinks and residuals: for tracks that are about to be ready, or
    // still have open sides or kinks.
    mask_of<T> ready =
        works & (moved < settings_.tolerance * settings_.tolerance) & !wires_only_ & !group_.left;
    const mask_of<T> judged = iteration_ >= impatient_iterations ? works : ready;
    if (last || any(judged) || any((open_ | group_.kinked) & works)) {
      smooth(group_, works);
      if (any(open_ & works)) ready = ready & renew_sides(group_, works, iteration_ < 2);
      if (settings_.outlier_pull > 0)
        ready = ready & renew_outliers(group_, judged, settings_.outlier_pull, iteration_ < last_return);
    }
    if (kinks_) {
      ready = ready & ((abs(estimate.chi2 - chi2_) < settings_.tolerance) | !group_.kinked);
      ready = ready & !bend(judged & !wires_only_);
      chi2_ = select(works, estimate.chi2, chi2_);
    }
    wires_only_ = wires_only_ & !works;
    store(ready, estimate, FitStatus::ok);
    active_ = active_ & !ready;
    if (last) store(works & !ready, estimate, FitStatus::not_converged);
  }

  // Where a linear fit has settled, or does not, slow tracks get kinks: angles, shifts and curvature multiply
  // where a track is scattered by more than a few mrad. Returns which did now.
  mask_of<T> bend(mask_of<T> who) {
    who = who & !group_.kinked;
    if (!any(who) || iteration_ + kink_iterations >= settings_.max_iterations) return mask_of<T>(false);
    who = who & (scattering() > least_scattering);
    if (!any(who)) return who;
    for (Kink<T>& kink : group_.kinks) {
      kink.aside = select(group_.kinked, kink.aside, T(0.0));
      kink.up = select(group_.kinked, kink.up, T(0.0));
      kink.cosine = select(group_.kinked, kink.cosine, T(1.0));
      kink.sine = select(group_.kinked, kink.sine, T(0.0));
    }
    group_.kinked = group_.kinked | who;
    smooth(group_, who);
    return who;
  }

  // Variance of the angle behind all matter, rad^2.
  T scattering() const {
    T sum(0.0);
    for (const Kink<T>& kink : group_.kinks) sum += kink.sigma * kink.sigma;
    return sum;
  }

  void trace(T mass, Projectile projectile) {
    if (detector_.field.is_uniform()) {
      Tracer<T>(detector_, helix_, mass, projectile, group_).run(active_);
    } else {
      Tracer<T, FieldReference<T>>(detector_, helix_, mass, projectile, group_).run(active_);
    }
  }

  // The covariance that the filter begins with. Rounding grows with its ratio to what comes out: once there
  // are variances from the iteration before, a few thousand times those is as good as none and no weaker than
  // it has to be. Not their correlations: what inner hits know together would be taken for what outer ones
  // do. Its mean is the present reference, so that it does not pull anywhere once that has settled.
  Symmetric<T> beginning(const Five<T>& prior) const {
    constexpr double ratio = 4000;
    Five<T> variance = prior;
    if (iteration_ > 0)
      unroll<parameters>([&](auto i) { variance[i] = smaller(ratio * known_[i], prior[i]); });
    return Symmetric<T>::diagonal(variance);
  }

  mask_of<T> has_open_sides() const {
    mask_of<T> open(false);
    for (const Slot<T>& slot : group_.slots)
      if (slot.view == View::wire) open = open | (slot.there & (slot.known_side == 0.0));
    return open;
  }

  // Where the reference stops before the last hits it gets more momentum: half of the way back to the last
  // one that did not, or just more. Where that does not help, the hits beyond have been given up.
  mask_of<T> speed_up(bool last) {
    const mask_of<T> stopped = active_ & group_.stopped;
    if (iteration_ > patient_iterations || last) return finish(stopped, FitStatus::stopped);
    if (iteration_ < patient_iterations)
      helix_.kappa = select(
          stopped, select(passed_ != 0.0, 0.5 * (passed_ + helix_.kappa), 0.85 * helix_.kappa), helix_.kappa);
    return stopped;
  }

  // Hits that stay out of the reference's reach are given up after some iterations.
  void give_up_hits() {
    for (Slot<T>& slot : group_.slots) slot.there = slot.there & (slot.met | !active_);
    look_ahead(group_);
  }

  // As many measurements as parameters can be met by anything: at least one more is asked for.
  mask_of<T> too_few() const {
    mask_of<T> few(false);
    for (int k = 0; k < lanes_of<T>; ++k)
      set_lane(few, k, group_.reached[static_cast<std::size_t>(k)] <= parameters);
    return few;
  }

  // Ends the fit of these lanes. Returns them.
  mask_of<T> finish(mask_of<T> failed, FitStatus status) {
    if (!any(failed)) return failed;
    for (std::size_t k = 0; k < lanes_.size(); ++k) {
      if (!lane(failed, static_cast<int>(k))) continue;
      store_helix(k);
      lanes_[k].rows->status = status;
    }
    active_ = active_ & !failed;
    return failed;
  }

  // The new reference; a curvature that would more than double or change sign by itself is approached in
  // halves.
  void move(const Five<T>& x, mask_of<T> who) {
    const T limit = larger(0.5 * abs(helix_.kappa), 0.2);
    const T fraction = select(who, smaller(T(1.0), limit / larger(abs(x[2]), 1e-12)), T(0.0));
    const auto step = [&](T& parameter, T by) {
      parameter = select(who, parameter + fraction * by, parameter);
    };
    step(helix_.d, x[0]);
    step(helix_.psi, x[1]);
    step(helix_.kappa, x[2]);
    step(helix_.z0, x[3]);
    step(helix_.tanl, x[4]);
    helix_.kappa = select(helix_.kappa == 0.0, T(1e-9), helix_.kappa);
    const T turns = nearest(helix_.psi * (0.5 / pi));
    helix_.psi = helix_.psi - turns * (2 * pi);
  }

  void store(mask_of<T> who, const Estimate<T>& estimate, FitStatus status) {
    if (!any(who)) return;
    for (std::size_t k = 0; k < lanes_.size(); ++k) {
      if (!lane(who, static_cast<int>(k))) continue;
      store_helix(k);
      FitRow& row = *lanes_[k].rows;
      row.status = status;
      row.chi2 = lane(estimate.chi2, static_cast<int>(k));
      row.clusters = row.wires = row.outliers = 0;
      store_covariance(estimate.c, k, row.covariance);
      if (lanes_[k].last != nullptr) store_last(k, *lanes_[k].last);
    }
    for (const Slot<T>& slot : group_.slots) {
      const mask_of<T> met = who & slot.met;
      for (std::size_t k = 0; k < lanes_.size(); ++k)
        if (lane(met, static_cast<int>(k))) store_hit(slot, k);
    }
  }

  static void store_covariance(const Symmetric<T>& c, std::size_t k, std::array<double, 25>& out) {
    for (int i = 0; i < parameters; ++i) {
      for (int j = 0; j < parameters; ++j)
        out[static_cast<std::size_t>(parameters * i + j)] = lane(c(i, j), static_cast<int>(k));
    }
  }

  void store_helix(std::size_t k) {
    FitRow& row = *lanes_[k].rows;
    const int i = static_cast<int>(k);
    row.helix = {lane(helix_.d, i), wrap_angle(lane(helix_.psi, i) - 0.5 * pi), lane(helix_.kappa, i),
                 lane(helix_.z0, i), lane(helix_.tanl, i)};
    row.iterations = iteration_ + 1;
  }

  void store_hit(const Slot<T>& slot, std::size_t k) {
    const FitLane& to = lanes_[k];
    const int i = static_cast<int>(k);
    const bool used = lane(slot.used, i);
    ++(!used ? to.rows->outliers : slot.view == View::wire ? to.rows->wires : to.rows->clusters);
    if (to.hits == nullptr) return;
    const double weight = lane(slot.weight, i);
    to.hits[slot.hit[k]] = {lane(slot.unbiased, i), std::sqrt(lane(slot.unbiased_variance, i)),
                            static_cast<std::int8_t>(weight > 0 ? 1 : (weight < 0 ? -1 : 0)),
                            static_cast<std::uint8_t>(used)};
    if (to.measured != nullptr) to.measured[slot.hit[k]] = {lane(slot.value, i), lane(slot.variance, i)};
  }

  void store_last(std::size_t k, LastIteration& last) const {
    const int i = static_cast<int>(k);
    store_covariance(prior_, k, last.prior);
    KinkRow* kinks = lanes_[k].kinks;
    std::fill_n(kinks, detector_.slabs.size(), KinkRow{0, 0});
    for (const GroupStep& step : group_.steps) {
      if (!step.is_slab || !lane(group_.kinked, i)) continue;
      const Kink<T>& kink = reference_kinks_[static_cast<std::size_t>(step.noise)];
      kinks[step.slab] = {lane(kink.aside, i), lane(kink.up, i)};
    }
    last.reference = {lane(reference_.d, i), lane(reference_.psi, i), lane(reference_.kappa, i),
                      lane(reference_.z0, i), lane(reference_.tanl, i)};
  }

  const Detector& detector_;
  const FitSettings& settings_;
  Group<T>& group_;
  PerigeeOf<T> helix_, reference_;  // reference: of this iteration, once the helix is that of the next
  std::vector<Kink<T>> reference_kinks_;
  Symmetric<T> prior_;  // what the filter begins with
  Five<T> known_;       // variances of the iteration before
  T spread_, passed_;   // of the start; kappa of the last reference that did not stop, 0 before
  std::span<const FitLane> lanes_;
  mask_of<T> active_, open_, wires_only_;
  T chi2_;  // of the iteration before
  bool kinks_ = true;
  int iteration_ = 0;
};

}  // namespace cgemit

// The fit of a group of tracks, one per lane.
#pragma once

#include <array>
#include <cmath>
#include <span>

#include "kalman/field_reference.hpp"
#include "kalman/filter.hpp"
#include "kalman/tracer.hpp"
#include "reconstruction/fit/breaks.hpp"
#include "reconstruction/fit/first_guess.hpp"
#include "reconstruction/fit/lane_rows.hpp"
#include "reconstruction/fit/measured.hpp"
#include "reconstruction/fit/outliers.hpp"

namespace cgemit {

// Each group has a new object, so that nothing of one group can reach the next. `group` and `breaks` keep
// their memory; the fit writes into them before it reads.
template <class T>
class GroupFit {
 public:
  GroupFit(const Detector& detector, const FitSettings& settings, Group<T>& group, Breaks<T>& breaks,
           Interrupted interrupted)
      : detector_(detector), settings_(settings), group_(group), breaks_(breaks), interrupted_(interrupted) {}

  // Fits from `start`; `spread` (mm) is the distance of most hits from it. `wires_first`: the unknown sides
  // are determined from the wires alone before the clusters join. `kinks`: slow tracks get kinks.
  void run(const PerigeeOf<T>& start, T spread, const SpeciesOf<T>& species, std::span<const FitLane> lanes,
           bool wires_first, bool kinks) {
    species_ = species;
    lanes_ = lanes;
    kinks_ = kinks;
    spread_ = spread;
    helix_ = start;
    open_ = has_open_sides();
    wires_only_ = wires_first & open_;
    for (std::size_t k = 0; k < lanes.size(); ++k) set_lane(active_, static_cast<int>(k), true);
    Five<T> prior;
    unroll<parameters>([&](auto i) {
      const double sigma = settings_.prior_sigma[static_cast<std::size_t>(i)];
      prior[i] = sigma * sigma;
    });
    variance_ = prior;
    for (iteration_ = 0; iteration_ < settings_.max_iterations && any(active_); ++iteration_) {
      if (iteration_ % iterations_per_check == iterations_per_check - 1 && interrupted_()) return;
      iterate(prior);
    }
    if (!any(weighed_)) return;
    breaks_.weigh(species_.projectile == Projectile::electron);
    write_density(lanes_, breaks_, weighed_);
  }

  // Whether slow tracks may have kinks at all.
  static bool gives_kinks(const FitSettings& settings) {
    return settings.kinks && settings.max_iterations > kink_iterations;
  }

 private:
  static constexpr int iterations_per_check = 16;  // of whether the fit is interrupted
  static constexpr int rough_iterations = 2;
  static constexpr int patient_iterations = 6;
  static constexpr int impatient_iterations =
      4;                                     // from here on, outliers are looked for even without convergence
  static constexpr int last_return = 8;      // from this iteration on, outliers do not return
  static constexpr int kink_iterations = 4;  // iterations that must remain for kinks to converge
  static constexpr double least_scattering = 5e-5;  // rad^2; smaller variances are linear
  // A reference is kept for a helix that is this near, each times the tolerance.
  static constexpr double near_bend = 0.01;     // mm, neglected in a residual
  static constexpr double near_momentum = 0.1;  // relative
  static constexpr double near_sigmas = 100;
  // mm; in a weak field a first helix so close to a straight line does not measure the momentum.
  static constexpr double least_sagitta = 1;

  // The results of one iteration.
  struct Iteration {
    bool last;
    bool rough;              // in a uniform field instead of the map
    mask_of<T> kept;         // lanes whose reference and rows are those of the last iteration
    mask_of<T> works;        // lanes that are still being fitted
    FilteredState<T> state;  // at the origin, about the reference
    T moved;                 // largest step of a parameter, in standard deviations, squared
    mask_of<T> settled;      // lanes that may have converged
    mask_of<T> judged;       // lanes that are searched for outliers
  };

  void iterate(const Five<T>& prior) {
    Iteration now{};
    now.last = iteration_ + 1 == settings_.max_iterations;
    now.rough = iteration_ < rough_iterations && !now.last && !detector_.field.is_uniform();
    now.kept = near_ & active_ & !group_.kinked;
    if (was_rough_ && !now.rough) {
      now.kept = mask_of<T>(false);
      take_mean_field();
    }
    was_rough_ = now.rough;
    linearise(now);
    if (!any(now.works)) return;
    filter_inward(now, prior);
    smooth_outward(now);
    decide(now);
    near_ = now.works & active_;
    if (any(near_)) near_ = near_ & is_near(now.state);
  }

  // Follows the reference trajectory and computes the measurement of every hit on it.
  void linearise(Iteration& now) {
    if (iteration_ > patient_iterations) give_up_hits();
    if (any(active_ & !now.kept)) {
      trace(now.kept, now.rough);
      noise_ = noise_variances(group_);
    }
    if (any(now.kept)) follow_extents(group_, detector_, extents_at_, helix_, now.kept);
    extents_at_ = helix_;
    mask_of<T> works = active_;
    if (any(group_.stopped)) works = works & !speed_up(now.last);
    passed_ = select(works, helix_.kappa, passed_);
    const mask_of<T> few = too_few(), hopeless(now.last || iteration_ >= patient_iterations);
    works = works & !finish(works & group_.left & (few | hopeless), FitStatus::left_field);
    works = works & !finish(works & few, FitStatus::does_not_reach);
    now.works = works;
    if (!any(works)) return;
    // After radiation, electrons are far from any first helix.
    if (iteration_ == 0 && species_.projectile < Projectile::electron)
      first_guess(group_, scattering_helix(), species_, spread_, works, settings_.outlier_pull > 0);
    if (settings_.outlier_pull > 0) keep_enough(group_, works);
    fill_slots(group_, detector_, settings_, T(species_.charge * species_.charge), wires_only_);
  }

  // Computes the state at the origin and the next reference.
  void filter_inward(Iteration& now, const Five<T>& prior) {
    reference_.prior = beginning(prior);
    reference_.helix = select<T>(now.kept, reference_.helix, helix_);
    now.state = filter(detector_, group_, reference_.prior);
    constrain(now.state);
    now.works = now.works & !finish(now.works & !(positive_definite(now.state.c) & sound(now.state)),
                                    FitStatus::not_positive_definite);
    if (any(group_.kinked)) reference_.kinks = group_.kinks;
    moved_ = select<T>(now.kept, moved_, Five<T>::zero());
    const Five<T> step = now.state.x - moved_;
    now.moved = T(0.0);
    unroll<parameters>([&](auto i) {
      now.moved = larger(now.moved, step[i] * step[i] / now.state.c(i, i));
      variance_[i] = select(now.works, now.state.c(i, i), variance_[i]);
    });
    move(step, now.works);
  }

  // Takes the beam spot as the innermost measurements, if it is given. Residuals of hits do without it.
  void constrain(FilteredState<T>& state) {
    const PerigeeOf<T>& from = reference_.helix;
    for (std::size_t i = 0; i < 2 && settings_.beam[i] > 0; ++i) {
      Slot<T>& slot = beam_[i];
      slot.used = mask_of<T>(true);
      slot.row = Five<T>::zero();
      slot.row[i == 0 ? 0 : 3] = 1.0;
      slot.variance = settings_.beam[i] * settings_.beam[i];
      slot.residual = i == 0 ? -from.d : -from.z0;
      update(state, slot);
    }
  }
  std::span<const Slot<T>> beam() const {
    return std::span(beam_).first(settings_.beam[0] > 0 ? (settings_.beam[1] > 0 ? 2 : 1) : 0);
  }

  // Whether a helix is so close to the reference that a new reference would give the same fit: rows are exact
  // but for the square of the distance times the curvature, noise and loss change with the momentum, and the
  // filter's prior pulls towards the reference.
  mask_of<T> is_near(const FilteredState<T>& state) const {
    T farthest(0.0), sigmas(0.0);
    for (const Slot<T>& slot : group_.slots) {
      const Five<T>&h = slot.row, &x = state.x;
      // V is linear in z.
      const T away = slot.view == View::wire ? dot(h, x) : h[0] * x[0] + h[1] * x[1] + h[2] * x[2];
      farthest = larger(farthest, abs(away));
    }
    unroll<parameters>([&](auto i) { sigmas = larger(sigmas, state.x[i] * state.x[i] / state.c(i, i)); });
    const T bend = abs(curvature(detector_.bz, 1.0) * helix_.kappa), slower = abs(state.x[2] / helix_.kappa);
    const double t = settings_.tolerance;
    return (0.5 * farthest * farthest * bend < near_bend * t) & (slower < near_momentum * t) &
           (sigmas < near_sigmas * near_sigmas * t * t) & !group_.left;
  }

  // Residuals to the track without the hit. They update the weights of sides, outliers and kinks, and are
  // needed only for tracks close to convergence; the other tracks skip them.
  void smooth_outward(Iteration& now) {
    now.settled =
        now.works & (now.moved < settings_.tolerance * settings_.tolerance) & !wires_only_ & !group_.left;
    if (now.rough) now.settled = mask_of<T>(false);
    now.judged = iteration_ >= impatient_iterations ? now.works : now.settled;
    if (!now.last && !any(now.judged) && !any((open_ | group_.kinked) & now.works)) return;
    smooth(group_, now.works);
    if (any(open_ & now.works)) now.settled = now.settled & renew_sides(group_, now.works, iteration_ == 0);
    if (settings_.outlier_pull > 0)
      now.settled = now.settled & renew_outliers(group_, now.judged & !is_broken(now.judged),
                                                 settings_.outlier_pull, iteration_ < last_return);
  }

  // Lanes of `who` in which a break by radiation explains more than leaving out the worst hit would.
  mask_of<T> is_broken(mask_of<T> who) {
    if (!has_density()) return mask_of<T>(false);
    const T worst = worst_pull(group_);
    who = who & (worst > settings_.outlier_pull * settings_.outlier_pull);
    if (!any(who)) return who;
    breaks_.look(group_, beam(), helix_, charge_sec() / abs(helix_.kappa));
    return who & (breaks_.best() > worst);
  }

  bool has_density() const { return Breaks<T>::apply(detector_, species_.projectile); }

  // Decides which lanes have converged; the others continue from the new reference.
  void decide(Iteration& now) {
    mask_of<T> ready = now.settled;
    if (kinks_) {
      ready = ready & ((abs(now.state.chi2 - chi2_) < settings_.tolerance) | !group_.kinked);
      ready = ready & !bend(now.judged & !wires_only_);
      chi2_ = select(now.works, now.state.chi2, chi2_);
    }
    wires_only_ = wires_only_ & !now.works;
    store(ready, now.state, FitStatus::ok);
    active_ = active_ & !ready;
    if (now.last) store(now.works & !ready, now.state, FitStatus::not_converged);
  }

  // Slow tracks get kinks once a linear fit has converged, or fails to: angles, shifts and curvature multiply
  // where scattering exceeds a few mrad. Returns the lanes that got kinks now.
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

  // Variance of the angle after all matter, rad^2.
  T scattering() const {
    T sum(0.0);
    for (const Kink<T>& kink : group_.kinks) sum += kink.sigma * kink.sigma;
    return sum;
  }

  // The first iterations, which start some standard deviations off and look for the sides of the wires, take
  // the field at the origin for the field everywhere: a fifth of the time of a map.
  void trace(mask_of<T> kept, bool roughly) {
    const mask_of<T> who = active_ & !kept;
    choose_momentum(who);
    if (detector_.field.is_uniform() || roughly) {
      Tracer<T>(detector_, helix_, species_, group_, {}, matter_).run(who, kept);
    } else {
      Tracer<T, FieldReference<T>>(detector_, helix_, species_, group_, {}, matter_).run(who, kept);
    }
  }

  // Chooses the momentum in matter of the lanes `who`. A first helix that is close to a straight line in a
  // weak field does not measure it. Once a fitted kappa does, it stays so: with its own momentum a slow track
  // scatters more, and would return to the given one.
  void choose_momentum(mask_of<T> who) {
    MatterMomentum<T> now{mask_of<T>(false), T(settings_.momentum)};
    if (iteration_ > 0) {
      now = MatterMomentum<T>::of_fit(helix_.kappa, sqrt(variance_[2]), charge_sec(), settings_.momentum,
                                      detector_.bz);
      now.given = now.given & !measured_;
      measured_ = measured_ | (who & !now.given);
    } else if (std::abs(detector_.bz) < MatterMomentum<T>::weak_field) {
      const T last = last_radius(&Slot<T>::there), w = curvature(detector_.bz, helix_.kappa);
      now.given = !(0.125 * abs(w) * last * last > least_sagitta);
    }
    matter_.given = (now.given & who) | (matter_.given & !who);
    matter_.p = select(who, now.p, matter_.p);
  }

  // Momentum of the helix with kappa 1.
  T charge_sec() const { return species_.charge * sqrt(1.0 + helix_.tanl * helix_.tanl); }

  // The helix with the kappa of the momentum in matter.
  PerigeeOf<T> scattering_helix() const {
    PerigeeOf<T> helix = helix_;
    if (any(matter_.given)) helix.kappa = select(matter_.given, charge_sec() / matter_.p, helix.kappa);
    return helix;
  }

  // Radius of the outermost hit, of those that a flag of the slots selects.
  T last_radius(mask_of<T> Slot<T>::* flag) const {
    T last(0.0);
    for (const Slot<T>& slot : group_.slots) {
      const T radius = slot.view == View::wire
                           ? sqrt(slot.wire.x * slot.wire.x + slot.wire.y * slot.wire.y)
                           : T(detector_.layers[static_cast<std::size_t>(slot.layer)].r_mid());
      last = larger(last, select(slot.*flag, radius, T(0.0)));
    }
    return last;
  }

  // The covariance of the filter's prior. Rounding error grows with the ratio of prior to posterior, so after
  // the first iteration the prior is 4000 times the variances beyond all matter: the last diagonal variances
  // at the origin and the noise. Without the noise the prior would hold a precise vertex detector's knowledge
  // of the origin against the outer hits. Correlations are dropped: they would leak information of the inner
  // hits into the outer ones. The mean of the prior is the present reference, so that the prior has no bias
  // after convergence.
  Symmetric<T> beginning(const Five<T>& prior) const {
    constexpr double ratio = 4000;
    Five<T> variance = prior;
    if (iteration_ > 0) {
      unroll<parameters>(
          [&](auto i) { variance[i] = smaller(ratio * (variance_[i] + noise_[i]), prior[i]); });
    }
    return Symmetric<T>::diagonal(variance);
  }

  // The rough iterations end with the right curvature, but in the field at the origin. The momentum follows
  // from the mean field that bends the track up to its last hit. The weights are those of the curvature of a
  // parabola through evenly spaced hits, from an eighth of the way on.
  void take_mean_field() {
    if (is_straight(detector_.bz)) return;
    const T last = last_radius(&Slot<T>::met);
    const HelixPointOf<T> origin = closest_point(helix_, curvature(detector_.bz, 1.0));
    HelixPointOf<T> end = origin;
    T arc(0.0);
    const mask_of<T> reached = step_to_cylinder(end, last, arc);
    arc = select(reached, arc, arc_to_apex(origin));
    T mean(0.0);
    for (const auto& [part, weight] : {std::pair{0.34, 9.0}, {0.56, 16.0}, {0.78, 9.0}}) {
      HelixPointOf<T> at = origin;
      advance(at, T(part * arc));
      const Vec3<T> b = detector_.field.at(Vec3<T>{at.x, at.y, at.z}).b;
      mean += (weight / 34) * (b.z - at.tanl * (at.ux * b.x + at.uy * b.y));
    }
    helix_.kappa =
        select(active_ & (mean * detector_.bz > 0.0), helix_.kappa * detector_.bz / mean, helix_.kappa);
  }

  mask_of<T> has_open_sides() const {
    mask_of<T> open(false);
    for (const Slot<T>& slot : group_.slots)
      if (slot.view == View::wire) open = open | (slot.there & (slot.known_side == 0.0));
    return open;
  }

  // If the reference stops before the last hits, its momentum is raised: kappa moves halfway back to that of
  // the last reference that did not stop, or is reduced by a fixed factor. If that does not help, the hits
  // beyond are given up.
  mask_of<T> speed_up(bool last) {
    const mask_of<T> stopped = active_ & group_.stopped;
    if (iteration_ > patient_iterations || last) return finish(stopped, FitStatus::stopped);
    if (iteration_ < patient_iterations)
      helix_.kappa =
          select(stopped & !matter_.given,
                 select(passed_ != 0.0, 0.5 * (passed_ + helix_.kappa), 0.85 * helix_.kappa), helix_.kappa);
    return stopped;
  }

  // Hits that the reference does not reach are given up after some iterations.
  void give_up_hits() {
    for (Slot<T>& slot : group_.slots) slot.there = slot.there & (slot.met | !active_);
    look_ahead(group_);
  }

  // Any track can meet as many measurements as it has parameters: at least one more is required.
  mask_of<T> too_few() const {
    mask_of<T> few(false);
    for (int k = 0; k < lanes_of<T>; ++k)
      set_lane(few, k, group_.reached[static_cast<std::size_t>(k)] <= parameters);
    return few;
  }

  // Ends the fit of these lanes. Returns the lanes.
  mask_of<T> finish(mask_of<T> failed, FitStatus status) {
    if (!any(failed)) return failed;
    for (std::size_t k = 0; k < lanes_.size(); ++k) {
      if (!lane(failed, static_cast<int>(k))) continue;
      write_helix(*lanes_[k].rows, helix_, static_cast<int>(k), iteration_ + 1);
      lanes_[k].rows->status = status;
    }
    active_ = active_ & !failed;
    return failed;
  }

  // The new reference. A step that would change the curvature by more than half of it is shortened.
  void move(const Five<T>& x, mask_of<T> who) {
    const T limit = larger(0.5 * abs(helix_.kappa), 0.2);
    // Where matter acts with a given momentum, nothing but the curvature depends on kappa.
    const T most = any(matter_.given) ? select(matter_.given, T(HUGE_VAL), limit) : limit;
    const T fraction = select(who, smaller(T(1.0), most / larger(abs(x[2]), 1e-12)), T(0.0));
    moved_ = moved_ + fraction * x;
    const auto step = [&](T& parameter, T by) {
      parameter = select(who, parameter + fraction * by, parameter);
    };
    step(helix_.d, x[0]);
    step(helix_.psi, x[1]);
    step(helix_.kappa, x[2]);
    step(helix_.z0, x[3]);
    step(helix_.tanl, x[4]);
    if (is_straight(detector_.bz)) {
      const T kappa = charge_sec() / settings_.momentum;
      helix_.kappa = select(who, copysign(kappa, helix_.kappa), helix_.kappa);
    }
    helix_.kappa = select(helix_.kappa == 0.0, T(1e-9), helix_.kappa);
    const T turns = nearest(helix_.psi * (0.5 / pi));
    helix_.psi = helix_.psi - turns * (2 * pi);
  }

  // Keeps what the density of the momentum of electrons needs. Where it is not measured, matter acts with a
  // given one.
  void weigh_losses(mask_of<T> who, const FilteredState<T>& state) {
    const T per_kappa = 1.0 / helix_.kappa, slope = helix_.tanl / (1.0 + helix_.tanl * helix_.tanl);
    const T variance = state.c(2, 2) * per_kappa * per_kappa - 2.0 * slope * state.c(2, 4) * per_kappa +
                       slope * slope * state.c(4, 4);
    who = who & !matter_.given & (variance < most_error * most_error);
    if (!any(who)) return;
    breaks_.look(group_, beam(), helix_, charge_sec() * abs(per_kappa));
    breaks_.keep(who, variance, helix_.tanl, species_);
    weighed_ = weighed_ | who;
  }

  void store(mask_of<T> who, const FilteredState<T>& state, FitStatus status) {
    if (!any(who)) return;
    if (has_density()) weigh_losses(who, state);
    for (std::size_t k = 0; k < lanes_.size(); ++k) {
      const int i = static_cast<int>(k);
      if (!lane(who, i)) continue;
      write_helix(*lanes_[k].rows, helix_, i, iteration_ + 1);
      write_state(*lanes_[k].rows, state, i, status);
      lanes_[k].rows->matter_p = lane(matter_.given, i) ? lane(matter_.p, i) : 0;
      if (lanes_[k].last != nullptr)
        write_reference(lanes_[k], reference_, group_, i, detector_.slabs.size());
    }
    write_hits(lanes_, group_, who);
  }

  const Detector& detector_;
  const FitSettings& settings_;
  Group<T>& group_;
  Breaks<T>& breaks_;
  Interrupted interrupted_;
  SpeciesOf<T> species_{};
  std::span<const FitLane> lanes_{};
  bool kinks_ = false;
  T spread_{0.0};  // of the start
  int iteration_ = 0;
  mask_of<T> active_{false};                    // lanes that have neither converged nor failed
  mask_of<T> open_{false}, wires_only_{false};  // with unknown sides; with these fitted to the wires alone
  PerigeeOf<T> helix_{};                        // linearisation point of the next iteration
  LinearisedAbout<T> reference_{};              // linearisation point of this iteration
  Five<T> moved_{};                             // from the reference to `helix_`
  mask_of<T> near_{false};                      // lanes that may keep their reference
  PerigeeOf<T> extents_at_{};                   // helix for which the extents of the slots hold
  bool was_rough_ = false;                      // the previous iteration
  T passed_{0.0};                               // kappa of the last reference that did not stop, 0 if none
  MatterMomentum<T> matter_{};                  // of the last trace
  mask_of<T> measured_{false};                  // lanes whose fitted kappa has measured the momentum
  Five<T> noise_{};                             // variances that all matter adds
  Five<T> variance_{};                          // of the previous iteration
  T chi2_{0.0};                                 // of the previous iteration
  std::array<Slot<T>, 2> beam_{};               // the beam spot as measurements of d and z0
  mask_of<T> weighed_{false};                   // lanes whose density is made at the end
};

}  // namespace cgemit

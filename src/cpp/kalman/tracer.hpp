// Follows the reference trajectory from the origin outward: predicts every measurement and computes its row
// and the noise in the coordinates of the origin. Scattering and loss are the moments of `matter/`.
#pragma once

#include <cmath>

#include "common/compiler.hpp"
#include "kalman/group.hpp"
#include "kalman/helix_motion.hpp"
#include "kalman/slab_crossing.hpp"
#include "motion/displaced.hpp"

namespace cgemit {

// An observer is called at every surface of the trajectory; this one does nothing. An observer with
// `provides_hits` also fills in the hits of every step when the reference arrives there, in place of a
// `GroupBuilder` before: `reaches` at a slab, `passes` at a layer of wires; and tells at the closest approach
// to a wire, in `on_wire`, which lanes pass between its ends. For one that `stops_at_wires`, the motion
// stands at every wire when it is met.
struct NoObserver {
  static constexpr bool provides_hits = false, stops_at_wires = false;
  template <class Slot, class Motion>
  void meets(const Slot&, const Motion&) {}
  template <class Slab, class Motion>
  void arrives(const Slab&, const Motion&) {}
  template <class Slab, class Noise, class Kink>
  void crosses(const Slab&, const Noise&, const Kink&) {}
  template <class Motion>
  void ends(const Motion&) {}
};

// The momentum at the origin with which a track scatters and loses energy. In the lanes `given` the curvature
// does not measure it: kappa then bends the track, and nothing else.
template <class T>
struct MatterMomentum {
  mask_of<T> given{false};
  T p{1.0};  // GeV/c, of the lanes `given`

  // Below this field, T, nearly all tracks may be as good as straight.
  static constexpr double weak_field = 0.2;

  // Of a fitted kappa with its standard deviation, in a field of bz (T) at the origin. A kappa of enough of
  // these is that of the momentum: of 10 in a weak field; of 2 in others, where tracks whose momentum is
  // known worse are stubs of slow particles, not of the given momentum. Otherwise the momentum is the given
  // one, or a larger one if the curvature excludes that one: scattering must not follow a curvature that is
  // due to the residuals. `charge_sec`: unsigned charge times sec(lambda), the momentum of a track with
  // kappa 1.
  static MatterMomentum of_fit(const T& kappa, const T& sigma, const T& charge_sec, double momentum,
                               double bz) {
    constexpr double allowed = 3;
    const double measured = std::abs(bz) < weak_field ? 10 : 2;
    const T own = abs(kappa);
    return {!(own > measured * sigma), charge_sec / smaller(charge_sec / momentum, own + allowed * sigma)};
  }

  T of(const T& kappa, const T& charge_sec) const {
    const T own = charge_sec / abs(kappa);
    return any(given) ? select(given, p, own) : own;
  }
};

// The hot functions are flattened: they call small functions, and numbers should stay in registers.
template <class T, class Motion = HelixMotion<T>, class Observer = NoObserver>
class Tracer {
 public:
  Tracer(const Detector& detector, const PerigeeOf<T>& start, const SpeciesOf<T>& species, Group<T>& group,
         Observer observer = {}, const MatterMomentum<T>& matter = {})
      : detector_(detector),
        group_(group),
        motion_(detector, start),
        dip_(start.tanl),
        given_(matter.given),
        charge_(species.charge),
        now_(matter.of(start.kappa, charge_ * dip_.sec), species),
        track_(track_matter(detector, start.tanl, now_)),
        observer_(observer) {}

  // Traces the lanes `who`. What the group holds of the lanes `kept` stays as it is.
  void run(mask_of<T> who, mask_of<T> kept = mask_of<T>(false)) {
    kept_ = kept;
    reached_ = 0.0;
    group_.stopped = group_.left = mask_of<T>(false);
    group_.dense = !Motion::keeps_dip;
    alive_ = who;
    curled_ = mask_of<T>(false);
    const T inner = motion_.point().radius();
    for (std::size_t i = 0; i < group_.steps.size(); ++i) {
      GroupStep& step = group_.steps[i];
      if (!step.is_slab) {
        if constexpr (Observer::provides_hits) observer_.passes(step, motion_, alive_);
        if (spans && i + 1 < group_.steps.size() && group_.steps[i + 1].is_slab) continue;  // with the slab
        go_past(step, HUGE_VAL, mask_of<T>(false));
        continue;
      }
      const Slab& slab = detector_.slabs[static_cast<std::size_t>(step.slab)];
      const auto noise = static_cast<std::size_t>(step.noise);
      const mask_of<T> beyond = group_.ahead[noise];
      const mask_of<T> wanted = alive_ & (beyond | has_hits(step)) & (inner < slab.radius);
      // A helix that turns back below a slab may still pass the next wires, but not a gap.
      mask_of<T> reached = wanted & !curled_;
      if (spans && i > 0 && !group_.steps[i - 1].is_slab)
        reached = go_past(group_.steps[i - 1], slab.radius, reached) & alive_;
      else
        reached = reached & motion_.go_to(slab.radius, reached);
      follow_dip();
      if constexpr (Observer::provides_hits) observer_.reaches(step, slab, motion_, reached);
      if (slab.gap >= 0) alive_ = alive_ & (reached | !wanted);
      for (std::int32_t s = step.first; s < step.last; ++s) meet_gap(slot(s), reached);
      cross(slab, noise, reached & beyond & slab.ends.hold(motion_.point().z));
    }
    count_reached();
    observer_.ends(motion_);
  }

  // Meets the hits of tracks that were recorded (`covariance/recorded.hpp`), but for a turn about the beam
  // line.
  template <class Steps>
  void replay(const Steps& steps, const SineCosine<T>& turn, const T& azimuth) {
    reached_ = 0.0;
    alive_ = mask_of<T>(true);
    for (std::size_t i = 0; i < steps.size(); ++i) {
      if (!steps[i].has_hits) continue;
      GroupStep& step = group_.steps[i];
      motion_ = Motion(steps[i].motion, turn);
      if (step.is_slab) {
        observer_.reaches(step, detector_.slabs[static_cast<std::size_t>(step.slab)], motion_, alive_);
        for (std::int32_t s = step.first; s < step.last; ++s) meet_gap(slot(s), alive_);
        continue;
      }
      observer_.passes(step, steps[i], motion_, azimuth);
      for (std::int32_t s = step.first; s < step.last; ++s) {
        Motion to_wire = motion_;
        meet_wire(to_wire, slot(s));
      }
    }
    count_reached();
  }
  // The next tracks to be replayed, with the same momentum.
  void observe(const Observer& observer) { observer_ = observer; }

 private:
  static constexpr bool spans = !Motion::keeps_dip && !Observer::stops_at_wires;
  static constexpr double seam_margin =
      50;  // mm, more than the distance of a first helix from its hits at any CGEM layer

  void count_reached() {
    for (int k = 0; k < lanes_of<T>; ++k)
      if (!lane(kept_, k))
        group_.reached[static_cast<std::size_t>(k)] = static_cast<std::int32_t>(lane(reached_, k));
  }

  Slot<T>& slot(std::int32_t s) { return group_.slots[static_cast<std::size_t>(s)]; }

  mask_of<T> has_hits(const GroupStep& step) {
    mask_of<T> some(false);
    for (std::int32_t s = step.first; s < step.last; ++s) some = some | slot(s).there;
    return some;
  }

  // The row of a hit that is not met is zero.
  void found(Slot<T>& slot, mask_of<T> met, T extent, T predicted, const Five<T>& row) {
    Five<T> row_here = all(met) ? row : select<T>(met, row, Five<T>::zero());
    if (any(kept_)) {
      slot.met = met | (slot.met & kept_);
      extent = select(kept_, slot.extent, extent);
      predicted = select(kept_, slot.predicted, predicted);
      row_here = select<T>(kept_, slot.row, row_here);
    } else {
      slot.met = met;
    }
    slot.extent = extent;
    slot.predicted = predicted;
    slot.row = row_here;
    reached_ += select(met, T(1.0), T(0.0));
    if (any(met)) observer_.meets(slot, motion_);
  }

  CGEMIT_FLATTEN void meet_gap(Slot<T>& slot, mask_of<T> reached) {
    const MeasuringLayer& layer = detector_.layers[static_cast<std::size_t>(slot.layer)];
    const HelixPointOf<T>& at = motion_.point();
    const Rows<T> r = motion_.rows();
    const T radius = at.radius(), outward = at.outward();
    const T tan_a = r.sideways / outward, per_cos = radius / outward;
    const T scale = layer.r_readout / radius;
    const double gap = layer.r_gap_out - layer.r_gap_in, around = 2 * pi * layer.r_readout;
    const T x_extent = scale * gap * tan_a, z_extent = gap * per_cos * dip_.tanl;
    const Five<T> row_x = (scale * per_cos) * r.across;
    HelixPointOf<T> shifted;
    if (layer.placement.moved) shifted = seen_by(layer.placement, at);
    const HelixPointOf<T>& seen = layer.placement.moved ? shifted : at;
    const T x = layer.r_readout * positive(atan2(seen.y, seen.x) - slot.edge);
    const mask_of<T> met = reached & slot.there;
    if (slot.view == View::x) {
      found(slot, met, abs(x_extent), x + around * nearest((slot.drift - x) * (1 / around)), row_x);
      return;
    }
    const double cosine = layer.cos_stereo, sine = layer.sin_stereo;
    const T v = x * cosine + (layer.z_ref() - seen.z) * sine;
    // Near the sheet's first edge the track and the hit may lie on either side of it.
    const T other = v + select(x < 0.5 * around, T(around * cosine), T(-around * cosine));
    const mask_of<T> near_edge = smaller(x, around - x) < seam_margin;
    const mask_of<T> take_other = near_edge & (abs(other - slot.drift) < abs(v - slot.drift));
    const T extent = abs(x_extent * cosine - z_extent * sine);
    T predicted = select(take_other, other, v);
    Five<T> row = T(cosine) * row_x - T(sine) * (r.along_z + (dip_.tanl * tan_a) * r.across);
    if (any(slot.k != 0.0)) {  // in the same turn as the measured X
      const T turns = around * nearest((slot.x - x) * (1 / around));
      predicted = select(slot.k != 0.0, v + cosine * turns - slot.k * (x + turns), predicted);
      row = row - slot.k * row_x;
    }
    found(slot, met, extent, predicted, row);
  }

  static T positive(T angle) { return select(angle < 0.0, angle + 2 * pi, angle); }

  // In a field map one move passes all wires of a step: to the next cylinder or, where it is not reached, to
  // the last wire. Returns the lanes of `who` that reach the cylinder.
  mask_of<T> go_past(const GroupStep& step, double radius, mask_of<T> who) {
    if constexpr (spans) {
      WireOf<T> last{};
      mask_of<T> some(false);
      for (std::int32_t s = step.first; s < step.last; ++s) {
        const mask_of<T> wanted = alive_ & slot(s).there;
        last = select(wanted, slot(s).wire, last);
        some = some | wanted;
      }
      who = motion_.go_past(last, some, radius, who);
    }
    for (std::int32_t s = step.first; s < step.last; ++s) meet_wire(slot(s));
    return who;
  }

  CGEMIT_FLATTEN void meet_wire(Slot<T>& slot) { meet_wire(motion_, slot); }

  CGEMIT_FLATTEN void meet_wire(Motion& motion, Slot<T>& slot) {
    const mask_of<T> wanted = alive_ & slot.there;
    if (!any(wanted)) {
      slot.met = slot.met & kept_;
      slot.row = any(kept_) ? select<T>(kept_, slot.row, Five<T>::zero()) : Five<T>::zero();
      return;
    }
    ApproachOf<T> approach;
    const mask_of<T> met = motion.approach(slot.wire, approach, wanted);
    if constexpr (!Motion::keeps_dip) group_.left = motion.left();
    alive_ = alive_ & (met | !wanted);
    const auto& [at, r] = motion.passage();
    curled_ = (wanted & (at.outward() < 0.0)) | (curled_ & !wanted);
    const T across = approach.ny * at.ux - approach.nx * at.uy;
    mask_of<T> hit = met;
    if constexpr (Observer::provides_hits) hit = met & observer_.on_wire(slot, approach.z_wire);
    found(slot, hit, T(0.0), approach.doca, across * r.across + approach.nz * r.along_z);
  }

  // Noise of a slab, then the energy loss of the reference. A lane ends where the particle stops.
  void cross(const Slab& slab, std::size_t number, mask_of<T> crosses) {
    if (!any(kept_)) {
      cross_all(slab, number, crosses);
      return;
    }
    const auto keep = [&](auto& noise) {
      const auto before = noise;
      cross_all(slab, number, crosses);
      blend(noise, !kept_, before);
    };
    const Kink<T> kink = group_.kinks[number];
    if constexpr (Motion::keeps_dip)
      keep(group_.noise[number]);
    else
      keep(group_.dense_noise[number]);
    Kink<T>& now = group_.kinks[number];
    now.sigma = select(kept_, kink.sigma, now.sigma);
  }

  CGEMIT_FLATTEN void cross_all(const Slab& slab, std::size_t number, mask_of<T> crosses) {
    Kink<T>& kink = group_.kinks[number];
    if (!any(crosses)) {
      if constexpr (Motion::keeps_dip)
        group_.noise[number] = {};
      else
        group_.dense_noise[number] = {};
      kink.aside = kink.up = kink.sigma = 0.0;
      return;
    }
    const HelixPointOf<T>& at = motion_.point();
    const T whole = path_factor(slab, dip_.sec, abs(at.outward()));
    T path = all(crosses) ? whole : select(crosses, whole, T(0.0));
    LossMomentsOf<T> loss = core_loss(slab, path, now_, track_);
    const mask_of<T> ends = crosses & stops(now_, loss);
    if (any(ends)) {
      group_.stopped = group_.stopped | ends;
      alive_ = alive_ & !ends;
      crosses = crosses & !ends;
      path = select(ends, T(0.0), path);
      loss = core_loss(slab, path, now_, track_);
    }
    const SlabCrossing<T> crossing = cross_outward(slab, path, now_, loss, track_);
    kink.sigma = select(crosses, crossing.theta, T(0.0));
    if (any(crosses)) observer_.arrives(slab, motion_);
    if (any(group_.kinked)) scatter(kink, crosses & group_.kinked);
    const auto act = [&](auto& noise) {
      make_noise(slab, crossing, noise);
      if (!all(crosses)) blend(noise, crosses, {});
      if (any(crosses)) observer_.crosses(slab, noise, kink);
    };
    if constexpr (Motion::keeps_dip)
      act(group_.noise[number]);
    else
      act(group_.dense_noise[number]);
    lose(crossing, crosses);
  }

  // Turns the reference by the kinks of the lanes `who`, and with it the horizontal axis across it.
  CGEMIT_NOINLINE void scatter(Kink<T>& kink, mask_of<T> who) {
    kink.aside = select(who, kink.aside, T(0.0));
    kink.up = select(who, kink.up, T(0.0));
    const T ahead = 1.0 - kink.up * dip_.tanl, turned = kink.aside * dip_.tanl;
    const T scale = 1.0 / sqrt(ahead * ahead + turned * turned);
    kink.cosine = ahead * scale;
    kink.sine = turned * scale;
    motion_.scatter(kink.aside, kink.up);
    set_dip();
  }

  void set_dip() { dip_ = Dip<T>(motion_.point().tanl); }

  template <class Noise>
  void make_noise(const Slab& slab, const SlabCrossing<T>& crossing, Noise& noise) const {
    const Rows<T> r = motion_.rows();
    const typename Motion::Backward origin(motion_, r);
    const LocalNoise<T> here = crossing.noise(slab, kappa_in_matter(), dip_, motion_.point().w);
    noise.turn = origin.turned(here.turn_psi);
    noise.dip = origin.changed(here.dip_kappa, here.dip_tanl);
    noise.straggling = origin.slowed(here.straggling_kappa);
    if (!slab.shifts) return;
    noise.shift_across = origin.moved(here.shift_across, T(0.0), T(0.0));
    noise.shift_along = origin.moved(T(0.0), here.shift_z, here.shift_psi);
  }

  // In a field map tanl changes along the track, and the track may leave the map.
  void follow_dip() {
    if constexpr (!Motion::keeps_dip) {
      set_dip();
      group_.left = motion_.left();
    }
  }

  // Takes the lanes outside `mask` from `other`.
  template <class Noise>
  static void blend(Noise& noise, mask_of<T> mask, const Noise& other) {
    const auto take = [mask](auto& numbers, const auto& others) {
      auto from = others.begin();
      for (T& x : numbers) x = select(mask, x, *from++);
    };
    take(noise.dip, other.dip);
    take(noise.straggling, other.straggling);
    take(noise.turn, other.turn);
    take(noise.shift_across, other.shift_across);
    take(noise.shift_along, other.shift_along);
  }

  // The kappa of the momentum that matter acts on.
  T kappa_in_matter() const {
    const T kappa = motion_.kappa();
    return any(given_) ? select(given_, copysign(charge_ * dip_.sec * now_.per_p, kappa), kappa) : kappa;
  }

  void lose(const SlabCrossing<T>& crossing, mask_of<T> crosses) {
    LossJacobian<T> j = crossing.jacobian(motion_.kappa(), dip_);
    if (any(given_)) {  // the loss is that of the given momentum, whatever kappa and tanl
      j.gain = select(given_, j.ratio, j.gain);
      j.mixed = select(given_, T(0.0), j.mixed);
    }
    if (all(crosses)) {
      motion_.lose(j.ratio, j.gain, j.mixed);
      now_ = crossing.after;
    } else {  // bit for bit as if the other lanes were absent
      motion_.lose(select(crosses, j.ratio, T(1.0)), select(crosses, j.gain, T(1.0)),
                   select(crosses, j.mixed, T(0.0)));
      now_ = select(crosses, crossing.after, now_);
    }
  }

  const Detector& detector_;
  Group<T>& group_;
  Motion motion_;
  Dip<T> dip_;
  mask_of<T> given_;
  T charge_;  // e, unsigned
  KinematicsOf<T> now_;
  TrackMatterOf<T> track_;
  T reached_{0.0};                           // hits
  mask_of<T> alive_{false}, curled_{false};  // curled: past the outermost point, no cylinder ahead
  mask_of<T> kept_{false};
  [[no_unique_address]] Observer observer_;
};

}  // namespace cgemit

// The reference from the origin outward: where it meets every measurement, with rows and noise in the
// coordinates of the origin. Scattering and loss are the moments of `matter/`.
#pragma once

#include <cmath>

#include "detector/strip_plane.hpp"
#include "kalman/group.hpp"
#include "kalman/helix_motion.hpp"
#include "matter/loss.hpp"
#include "matter/scattering.hpp"

namespace cgemit {

// Told of every place on the way; this one does not listen.
struct NoWatch {
  template <class Slot, class Motion>
  void meets(const Slot&, const Motion&) {}
  template <class Slab, class Motion>
  void arrives(const Slab&, const Motion&) {}
  template <class Slab, class Noise, class Kink>
  void crosses(const Slab&, const Noise&, const Kink&) {}
  template <class Motion>
  void ends(const Motion&) {}
};

// The hot functions are flattened: what they call is small, and numbers should stay in registers.
template <class T, class Motion = HelixMotion<T>, class Watch = NoWatch>
class Tracer {
 public:
  Tracer(const Detector& detector, const PerigeeOf<T>& start, T mass, Projectile projectile, Group<T>& group,
         Watch watch = {})
      : detector_(detector),
        group_(group),
        motion_(detector, start),
        tanl_(start.tanl),
        stretch_(sqrt(1.0 + tanl_ * tanl_)),
        now_(stretch_ / abs(start.kappa), mass, projectile),
        track_(total_matter(detector, start.tanl)),
        watch_(watch) {}

  // Of those lanes `who`.
  void run(mask_of<T> who) {
    group_.reached = {};
    group_.stopped = group_.left = mask_of<T>(false);
    alive_ = who;
    curled_ = mask_of<T>(false);
    const T inner = motion_.point().radius();
    for (const GroupStep& step : group_.steps) {
      if (!step.is_slab) {
        for (std::int32_t s = step.first; s < step.last; ++s) meet_wire(slot(s));
        continue;
      }
      const Slab& slab = detector_.slabs[static_cast<std::size_t>(step.slab)];
      const auto noise = static_cast<std::size_t>(step.noise);
      const mask_of<T> beyond = group_.ahead[noise];
      const mask_of<T> wanted = alive_ & (beyond | has_hits(step)) & (inner < slab.radius);
      // A helix that curls back below a slab may still pass by the next wires, but not by a gap.
      const mask_of<T> reached = wanted & !curled_ & motion_.go_to(slab.radius, wanted & !curled_);
      follow_dip();
      if (slab.gap >= 0) alive_ = alive_ & (reached | !wanted);
      for (std::int32_t s = step.first; s < step.last; ++s) meet_gap(slot(s), reached);
      cross(slab, noise, reached & beyond & (abs(motion_.point().z) <= slab.half_length));
    }
    watch_.ends(motion_);
  }

 private:
  static constexpr double seam_margin = 50;  // mm, more than a first helix is ever off at a CGEM layer

  Slot<T>& slot(std::int32_t s) { return group_.slots[static_cast<std::size_t>(s)]; }

  mask_of<T> has_hits(const GroupStep& step) {
    mask_of<T> some(false);
    for (std::int32_t s = step.first; s < step.last; ++s) some = some | slot(s).there;
    return some;
  }

  // Where nothing is met, nothing is learnt.
  void found(Slot<T>& slot, mask_of<T> met, T predicted, const Five<T>& row) {
    slot.met = met;
    slot.predicted = predicted;
    slot.row = all(met) ? row : select<T>(met, row, Five<T>::zero());
    for (int k = 0; k < lanes_of<T>; ++k) group_.reached[static_cast<std::size_t>(k)] += lane(met, k) ? 1 : 0;
    if (any(met)) watch_.meets(slot, motion_);
  }

  [[gnu::flatten]] void meet_gap(Slot<T>& slot, mask_of<T> reached) {
    const CgemLayer& layer = detector_.cgem[static_cast<std::size_t>(slot.layer)];
    const HelixPointOf<T>& at = motion_.point();
    const Rows<T> r = motion_.rows();
    const T radius = at.radius(), outward = at.outward();
    const T tan_a = r.sideways / outward, per_cos = radius / outward;
    const T scale = layer.r_readout / radius;
    const double gap = layer.r_gap_out - layer.r_gap_in, around = 2 * pi * layer.r_readout;
    const T x_extent = scale * gap * tan_a, z_extent = gap * per_cos * tanl_;
    const Five<T> row_x = (scale * per_cos) * r.across;
    const T x = layer.r_readout * positive(atan2(at.y, at.x) - slot.edge);
    const mask_of<T> met = reached & slot.there;
    if (slot.view == View::x) {
      slot.extent = abs(x_extent);
      found(slot, met, x + around * nearest((slot.drift - x) * (1 / around)), row_x);
      return;
    }
    const double cosine = layer.cos_stereo, sine = layer.sin_stereo;
    const T v = x * cosine + (layer.z_ref() - at.z) * sine;
    // Near the sheet's first edge track and hit may lie on either side of it.
    const T other = v + select(x < 0.5 * around, T(around * cosine), T(-around * cosine));
    const mask_of<T> near_edge = smaller(x, around - x) < seam_margin;
    const mask_of<T> take_other = near_edge & (abs(other - slot.drift) < abs(v - slot.drift));
    slot.extent = abs(x_extent * cosine - z_extent * sine);
    found(slot, met, select(take_other, other, v),
          T(cosine) * row_x - T(sine) * (r.along_z + (tanl_ * tan_a) * r.across));
  }

  static T positive(T angle) { return select(angle < 0.0, angle + 2 * pi, angle); }

  [[gnu::flatten]] void meet_wire(Slot<T>& slot) {
    const mask_of<T> wanted = alive_ & slot.there;
    if (!any(wanted)) {
      slot.met = mask_of<T>(false);
      slot.row = Five<T>::zero();
      return;
    }
    ApproachOf<T> approach;
    const mask_of<T> met = motion_.approach(slot.wire, approach, wanted);
    follow_dip();
    alive_ = alive_ & (met | !wanted);
    const HelixPointOf<T>& at = motion_.point();
    curled_ = (wanted & (at.outward() < 0.0)) | (curled_ & !wanted);
    const Rows<T> r = motion_.rows();
    const T across = approach.ny * at.ux - approach.nx * at.uy;
    slot.extent = 0.0;
    found(slot, met, approach.doca, across * r.across + approach.nz * r.along_z);
  }

  // Noise of a slab, then its energy loss on the reference. A lane dies where the particle stops.
  [[gnu::flatten]] void cross(const Slab& slab, std::size_t place, mask_of<T> crosses) {
    Kink<T>& kink = group_.kinks[place];
    if (!any(crosses)) {
      if constexpr (Motion::keeps_dip)
        group_.noise[place] = {};
      else
        group_.dense_noise[place] = {};
      kink.aside = kink.up = kink.sigma = 0.0;
      return;
    }
    const HelixPointOf<T>& at = motion_.point();
    const T whole = path_factor(slab, stretch_, abs(at.outward()));
    T path = all(crosses) ? whole : select(crosses, whole, T(0.0));
    LossMomentsOf<T> loss = core_loss(slab, path, now_, track_);
    const mask_of<T> stops = crosses & (now_.kinetic() - loss.loss < least_kinetic);
    if (any(stops)) {
      group_.stopped = group_.stopped | stops;
      alive_ = alive_ & !stops;
      crosses = crosses & !stops;
      path = select(stops, T(0.0), path);
      loss = core_loss(slab, path, now_, track_);
    }
    const KinematicsOf<T> after = now_.after_loss(loss.loss);
    const T theta = sqrt(scattering_variance(slab, path, now_, after, track_));
    kink.sigma = select(crosses, theta, T(0.0));
    if (any(crosses)) watch_.arrives(slab, motion_);
    if (any(group_.kinked)) scatter(kink, crosses & group_.kinked);
    const auto act = [&](auto& noise) {
      make_noise(slab, path, theta, loss, noise);
      if (!all(crosses)) mask_noise(noise, crosses);
      if (any(crosses)) watch_.crosses(slab, noise, kink);
    };
    if constexpr (Motion::keeps_dip)
      act(group_.noise[place]);
    else
      act(group_.dense_noise[place]);
    lose(loss, after, crosses);
  }

  // The reference turns by the kinks of those lanes `who`, and the horizontal across it with it.
  [[gnu::noinline]] void scatter(Kink<T>& kink, mask_of<T> who) {
    kink.aside = select(who, kink.aside, T(0.0));
    kink.up = select(who, kink.up, T(0.0));
    const T ahead = 1.0 - kink.up * tanl_, turned = kink.aside * tanl_;
    const T scale = 1.0 / sqrt(ahead * ahead + turned * turned);
    kink.cosine = ahead * scale;
    kink.sine = turned * scale;
    motion_.scatter(kink.aside, kink.up);
    set_dip();
  }

  void set_dip() {
    tanl_ = motion_.point().tanl;
    stretch_ = sqrt(1.0 + tanl_ * tanl_);
  }

  template <class Noise>
  void make_noise(const Slab& slab, T path, T theta, const LossMomentsOf<T>& loss, Noise& noise) const {
    const Rows<T> r = motion_.rows();
    const typename Motion::Backward origin(motion_, r);
    const T kappa = motion_.kappa();
    noise.turn = origin.turned(theta * stretch_);
    noise.dip = origin.changed(kappa * tanl_ * theta, stretch_ * stretch_ * theta);
    noise.straggling = origin.slowed(kappa * sqrt(loss.variance) * now_.energy * now_.per_p * now_.per_p);
    if (!slab.shifts) return;
    const T shift = theta * slab.spread * path;
    noise.shift_across = origin.moved(shift, T(0.0), T(0.0));
    // A shift in dip moves along the flight too, where the azimuth is another.
    noise.shift_along = origin.moved(T(0.0), shift * stretch_, motion_.point().w * shift * tanl_ / stretch_);
  }

  // In a field map the slope changes on the way, and the way may end.
  void follow_dip() {
    if constexpr (!Motion::keeps_dip) {
      set_dip();
      group_.left = motion_.left();
    }
  }

  template <class Noise>
  static void mask_noise(Noise& noise, mask_of<T> crosses) {
    const auto blend = [crosses](auto& numbers) {
      for (T& x : numbers) x = select(crosses, x, T(0.0));
    };
    blend(noise.dip);
    blend(noise.straggling);
    blend(noise.turn);
    blend(noise.shift_across);
    blend(noise.shift_along);
  }

  void lose(const LossMomentsOf<T>& loss, const KinematicsOf<T>& after, mask_of<T> crosses) {
    // dp'/dp at fixed tanl, and dp'/dtanl at fixed p, of p' = p(E(p) - loss(p, tanl)).
    const T energy_per_p = after.per_beta, ratio = now_.p * after.per_p;
    const T by_p = energy_per_p * (now_.p / now_.energy - loss.slope);
    const T slope = tanl_ / (stretch_ * stretch_);
    const T by_tanl = -energy_per_p * loss.loss * slope;
    const T gain = by_p * ratio * ratio;
    const T mixed = motion_.kappa() * ratio * (slope - by_p * ratio * slope - by_tanl * after.per_p);
    if (all(crosses)) {
      motion_.lose(ratio, gain, mixed);
      now_ = after;
    } else {  // to the last bit as if the others had not been there
      motion_.lose(select(crosses, ratio, T(1.0)), select(crosses, gain, T(1.0)),
                   select(crosses, mixed, T(0.0)));
      now_ = select(crosses, after, now_);
    }
  }

  const Detector& detector_;
  Group<T>& group_;
  Motion motion_;
  T tanl_, stretch_;
  KinematicsOf<T> now_;
  TrackMatterOf<T> track_;
  mask_of<T> alive_, curled_;  // curled: past the outermost point, no cylinder lies ahead
  [[no_unique_address]] Watch watch_;
};

}  // namespace cgemit

// Motion in a field map with the same interface as in a uniform field: to a cylinder, to the outermost point,
// to a wire. Each is a Newton iteration over Runge-Kutta steps; the helix that touches the track gives the
// step lengths.
#pragma once

#include <cmath>
#include <optional>

#include "detector/detector.hpp"
#include "motion/helix.hpp"
#include "motion/rkn.hpp"
#include "motion/wire.hpp"

namespace cgemit {

// A point that also stores its field. Its `w` is the curvature in this field, and its tanl changes along the
// track.
template <class T>
struct FieldHelixPoint : HelixPointOf<T> {
  FieldValue<T> field;

  friend FieldHelixPoint select(const mask_of<T>& m, const FieldHelixPoint& a, const FieldHelixPoint& b) {
    FieldHelixPoint p;
    static_cast<HelixPointOf<T>&>(p) = select<T>(m, static_cast<const HelixPointOf<T>&>(a), b);
    p.field = select(m, a.field, b.field);
    return p;
  }
};

// An arc is the path divided by 1/cos(dip) at its start. Every function moves the lanes `who` and returns
// those that arrived; the others stay where they are.
template <class T>
class FieldMotionOf {
 public:
  static constexpr bool keeps_dip = false;
  using Point = FieldHelixPoint<T>;
  using Mask = mask_of<T>;

  explicit FieldMotionOf(const FieldMap& field) : stepper_(field), field_(field) {}
  explicit FieldMotionOf(const Detector& detector) : FieldMotionOf(detector.field) {}

  // Sets the curvature of a point from kappa = charge/pT; the particle keeps charge/p.
  void bend(HelixPointOf<T>& point, const T& kappa) {
    set_bend(point, kappa);
    point.w = curvature(point, field_at(point).b, bend_);
  }
  // The same for a point that knows its field.
  void bend(Point& point, const T& kappa, const Mask& who = Mask(true)) {
    bend_ = select(who, kappa / (radius_per_kappa * sqrt(1.0 + point.tanl * point.tanl)), bend_);
    point.w = select(who, curvature<T>(point, point.field.b, bend_), point.w);
  }
  // Momentum loss: charge/p grows by the factor `ratio`.
  void lose(Point& point, const T& ratio) {
    bend_ *= ratio;
    point.w *= ratio;
  }
  // To be called after a change of direction at the same position and momentum.
  void turned(Point& point) const { point.w = curvature<T>(point, point.field.b, bend_); }
  // Flies the same path in the opposite direction from here on.
  void reverse(Point& point) {
    static_cast<HelixPointOf<T>&>(point) = reversed<T>(point);
    bend_ = -bend_;
  }
  // Evaluates the field at a point that was set directly.
  void look(Point& point) const { point.field = field_at(point); }
  // Derivatives to be propagated with every move; null: none.
  void carry(FieldDerivatives<T>* derivatives) { derivatives_ = derivatives; }

  T bz(const Point& point) const { return point.field.b.z; }
  T bz(const HelixPointOf<T>& point) const { return field_at(point).b.z; }
  const T& bending() const { return bend_; }  // charge/p in 1/(mm T)
  T charge_per_p() const { return bend_ * radius_per_kappa; }
  double tolerance() const { return field_.tolerance; }
  // Lanes whose last move ended outside the map.
  Mask left() const { return left_; }

  // As `step_to_cylinder`.
  template <class P>
  [[nodiscard]] Mask to_cylinder(P& point, const T& r, T& arc, bool outward = true, Mask who = Mask(true)) {
    Walk walk(*this, point, who);
    Mask arrived(false);
    for (int iteration = 0; any(walk.moving) && iteration < most_iterations; ++iteration) {
      T step = step_across(walk.here, r);
      const T p = walk.here.outward();
      const Mask near = walk.moving & (abs(step) < short_step) & (outward ? p > 0.0 : p < 0.0);
      Mask reached = near;
      if (any(walk.moving & !near)) {
        HelixPointOf<T> guess = walk.here;
        T far(0.0);
        reached = near | step_to_cylinder(guess, r, far, outward, walk.moving & !near);
        step = select(near, step, far);
      }
      if (const Mask missed = walk.moving & !reached; any(missed)) {
        // Either the cylinder lies below the closest approach, or the touching helix turns back before a
        // cylinder farther out. The track need not turn back there: it is followed to the turning point of
        // the helix and tried again.
        const T apex = arc_to_apex(walk.here);
        const Mask goes_on =
            missed & !(r < walk.here.radius()) & (apex > close) & (apex * abs(walk.here.w) < pi);
        step = select(goes_on, apex, step);
        walk.moving = walk.moving & (reached | goes_on);
      }
      const Mask corrected = walk.go(step) & reached;
      const Mask there = corrected & (abs(walk.here.radius() - r) < exact * (1.0 + r));
      arrived = arrived | (there & (outward ? walk.here.outward() >= 0.0 : walk.here.outward() < 0.0));
      walk.moving = walk.moving & !there;
    }
    arc = walk.finish(point, arrived);
    return arrived;
  }

  // To the next outermost point.
  template <class P>
  Mask to_apex(P& point, T& arc, Mask who = Mask(true)) {
    Walk walk(*this, point, who);
    T step = arc_to_apex<T>(point);
    walk.moving = walk.moving & (step < HUGE_VAL);
    Mask arrived(false);
    for (int iteration = 0; any(walk.moving) && iteration < most_iterations; ++iteration) {
      walk.go(step);
      const Mask there = walk.moving & (abs(step) < close);
      arrived = arrived | there;
      walk.moving = walk.moving & !there;
      // The turn, forward or backward, after which P vanishes.
      const T along = 1.0 - walk.here.w * walk.here.sideways(), p = walk.here.outward() / along;
      step = -p * atan_over(walk.here.w * p);
    }
    arrived = arrived | walk.moving;
    arc = walk.finish(point, arrived);
    return arrived;
  }

  // Moves by an arc, forward or backward.
  template <class P>
  void along(P& point, const T& arc) {
    Walk walk(*this, point, Mask(true));
    walk.go(arc);
    walk.finish(point, walk.moving);
  }

  // To the closest approach to the beam line, less than half a turn away.
  template <class P>
  Mask to_perigee(P& point, Mask who = Mask(true)) {
    Walk walk(*this, point, who);
    Mask arrived(false);
    for (int iteration = 0; any(walk.moving) && iteration < most_iterations; ++iteration) {
      const HelixPointOf<T>& p = walk.here;
      const Mask bends = p.w != 0.0;
      const T turn = atan2(p.w * p.outward(), 1.0 - p.w * p.sideways());
      const T step = select(bends, -turn / select(bends, p.w, T(1.0)), -p.outward());
      walk.go(step);
      const Mask there = walk.moving & (abs(step) < exact);
      arrived = arrived | there;
      walk.moving = walk.moving & !there;
    }
    walk.finish(point, arrived);
    return arrived;
  }

  // As `approach_wire`.
  template <class P>
  [[nodiscard]] Mask approach(P& point, const WireOf<T>& wire, ApproachOf<T>& result, Mask who = Mask(true)) {
    Walk walk(*this, point, who);
    Mask arrived(false);
    for (int iteration = 0; any(walk.moving) && iteration < most_iterations; ++iteration) {
      T arc(0.0);
      walk.moving = walk.moving & arc_to_wire(walk.here, wire, arc, walk.moving);
      const Mask there = walk.go(arc);
      arrived = arrived | there;
      walk.moving = walk.moving & !there;
    }
    result = distance_to_wire(walk.here, wire);
    if (!all(arrived)) result = select(arrived, result, ApproachOf<T>{});
    result.arc = walk.finish(point, arrived);
    return arrived;
  }

 protected:
  Mask left_{false};

 private:
  static constexpr int most_iterations = 20;

  // mm; an error along the track changes a distance in second order, a position in first order
  static constexpr double close = 1e-5, exact = 1e-12;
  static constexpr double short_step = 3e-3;  // mm; shorter steps need the curvature only

  // State of steps along the track; the points are unchanged before `finish`.
  struct Walk {
    FieldMotionOf& motion;
    Mask moving;
    HelixPointOf<T> here;
    FieldPoint<T> at;
    std::optional<CarriedDerivatives<T>> carried;
    T path{0.0};    // mm
    T cosine, sec;  // of the dip, at the start and here

    template <class P>
    Walk(FieldMotionOf& m, const P& point, const Mask& who)
        : motion(m),
          moving(who),
          here(point),
          at(m.start(point)),
          cosine(sqrt(at.t.x * at.t.x + at.t.y * at.t.y)),
          sec(1.0 / cosine) {
      m.left_ = Mask(false);
      if (m.derivatives_ != nullptr) carried.emplace(*m.derivatives_, at.t, at.field, m.bend_);
    }

    // Moving lanes take a step. Returns those whose step was short enough to be a correction only.
    Mask go(const T& arc) {
      const T step = select(moving, arc * sec, T(0.0));
      const Mask brief = moving & (abs(step) < short_step);
      if (const Mask far = moving & !brief; any(far)) {
        const Mask inside =
            motion.stepper_.advance(at, motion.bend_, step, far, carried ? &*carried : nullptr);
        motion.left_ = motion.left_ | (far & !inside);
        moving = moving & (brief | inside);
      }
      if (any(brief)) correct(select(brief, step, T(0.0)), brief);
      path += step;
      sec = 1.0 / sqrt(at.t.x * at.t.x + at.t.y * at.t.y);
      here = motion.to_helix(at, sec);
      return brief & moving;
    }

    void correct(const T& step, const Mask& who) {
      const Vec3<T> turn = motion.bend_ * cross(at.t, at.field.b),
                    change = step * at.t + 0.5 * step * step * turn;
      FieldPoint<T> next = at;
      next.x = at.x + change;
      next.t = at.t + step * turn;
      next.t = 1.0 / sqrt(dot(next.t, next.t)) * next.t;
      const Vec3<T> other = at.field.slope * change;
      next.field.b = at.field.b + other;
      if (carried) carried->extend(step, next.t, next.field.b, other, who);
      at = all(who) ? next : select(who, next, at);
    }

    template <class P>
    T finish(P& point, const Mask& arrived) {
      const T arc = select(arrived, path * cosine, T(0.0));
      if (carried) carried->finish(arrived);
      static_cast<HelixPointOf<T>&>(point) = all(arrived) ? here : select<T>(arrived, here, point);
      if constexpr (requires { point.field; })
        point.field = all(arrived) ? at.field : select(arrived, at.field, point.field);
      return arc;
    }
  };

  // Transverse arc to a cylinder that is very close, to third order.
  static T step_across(const HelixPointOf<T>& at, const T& r) {
    const T per = 1.0 / at.outward(), straight = 0.5 * per * (r * r - at.x * at.x - at.y * at.y);
    return straight - (0.5 * per) * (1.0 - at.w * at.sideways()) * (straight * straight);
  }

  FieldValue<T> field_at(const HelixPointOf<T>& p) const { return field_.at(Vec3<T>{p.x, p.y, p.z}); }
  void set_bend(const HelixPointOf<T>& point, const T& kappa) {
    bend_ = kappa / (radius_per_kappa * sqrt(1.0 + point.tanl * point.tanl));
  }
  static FieldPoint<T> start_with(const HelixPointOf<T>& p, const FieldValue<T>& field) {
    const T cosine = 1.0 / sqrt(1.0 + p.tanl * p.tanl);
    return {{p.x, p.y, p.z}, {cosine * p.ux, cosine * p.uy, cosine * p.tanl}, field};
  }
  FieldPoint<T> start(const HelixPointOf<T>& p) const { return start_with(p, field_at(p)); }
  FieldPoint<T> start(const Point& p) const { return start_with(p, p.field); }

  HelixPointOf<T> to_helix(const FieldPoint<T>& p, const T& per) const {
    HelixPointOf<T> point{p.x.x, p.x.y, p.x.z, per * p.t.x, per * p.t.y, per * p.t.z, T(0.0)};
    point.w = bend_ * per * (point.tanl * (point.ux * p.field.b.x + point.uy * p.field.b.y) - p.field.b.z);
    return point;
  }

  RungeKutta<T> stepper_;
  const FieldMap& field_;
  T bend_{0.0};
  FieldDerivatives<T>* derivatives_ = nullptr;
};
using FieldMotion = FieldMotionOf<double>;

}  // namespace cgemit

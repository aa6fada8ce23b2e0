// Motion in a field map for the simulation: the track to the next slab is known before the wires on the way,
// which then need no steps of their own.
#pragma once

#include "motion/path_span.hpp"

namespace cgemit {

// Each function acts on the lanes `who`; the others stay where they are.
template <class T>
class FieldAheadOf : public FieldMotionOf<T> {
  using Base = FieldMotionOf<T>;

 public:
  using Base::Base;
  using typename Base::Mask, typename Base::Point;

  // Moves lanes that have not looked ahead since the last slab on to a cylinder, outward.
  void look_ahead(const Point& from, double radius, const Mask& who) {
    const Mask fresh = who & !looked_;
    if (!any(fresh)) return;
    Point end = from;
    T arc(0.0);
    const Mask arrived = this->to_cylinder(end, T(radius), arc, true, fresh);
    const T sec = sqrt(1.0 + from.tanl * from.tanl), path = sec * arc;
    const Mask on = arrived & (from.outward() > 0.0) &
                    (PathSpan<T>::error(path, arc * from.w) < share_of_tolerance * this->tolerance());
    const Course course{
        {from, end, this->bending(), select(on, path, T(0.0))}, end, arc, from.radius(), 1.0 / sec};
    course_ = any(looked_) ? select(fresh, course, *course_) : course;
    on_course_ = on_course_ | on;
    looked_ = looked_ | fresh;
  }

  void forget_ahead() { looked_ = on_course_ = Mask(false); }

  // To the slab that ends what was looked at.
  Mask to_slab(Point& point, double radius, T& arc, const Mask& who) {
    const Mask known = who & on_course_;
    forget_ahead();
    if (!any(known)) return this->to_cylinder(point, T(radius), arc, true, who);
    const Mask others = who & !known;
    const Mask arrived = any(others) ? this->to_cylinder(point, T(radius), arc, true, others) : none();
    arc = any(others) ? select(known, course_->arc, arc) : select(known, course_->arc, T(0.0));
    point = all(known) ? course_->end : select(known, course_->end, point);
    return known | arrived;
  }

  // To the radius of wires, outward, from where it was looked ahead.
  Mask to_wires(Point& point, const T& radius, T& arc, const Mask& who) {
    on_wires_ = who & on_course_;
    if (!any(on_wires_)) return this->to_cylinder(point, radius, arc, true, who);
    const PathSpan<T>& track = course_->track;
    at_wires_ = track.start();
    const T length = track.path() * (radius - course_->radius) / (course_->end.radius() - course_->radius);
    on_wires_ = track.to_cylinder(radius, length, at_wires_, on_wires_);
    const Mask others = who & !on_wires_;
    const Mask arrived = any(others) ? this->to_cylinder(point, radius, arc, true, others) : none();
    const auto& [path, x, t] = at_wires_;
    const T per = 1.0 / sqrt(t.x * t.x + t.y * t.y);
    const T w = point.w + track.share(at_wires_) * (course_->end.w - point.w);
    const HelixPointOf<T> there{x.x, x.y, x.z, per * t.x, per * t.y, per * t.z, w};
    static_cast<HelixPointOf<T>&>(point) = select<T>(on_wires_, there, point);
    arc = select(on_wires_, path * course_->cosine, any(others) ? arc : T(0.0));
    return on_wires_ | arrived;
  }

  // To a wire, from its radius.
  Mask approach_near(Point& point, const WireOf<T>& wire, ApproachOf<T>& result, const Mask& who) {
    Mask met = who & on_wires_;
    if (any(met)) {
      typename PathSpan<T>::Place place = at_wires_;
      met = course_->track.approach(wire, place, met);
      const auto& [path, x, t] = place;
      const HelixPointOf<T> there{x.x, x.y, x.z, t.x, t.y, t.z, point.w};
      result = distance_to_wire(there, wire);
      result.arc = (path - at_wires_.length) * course_->cosine;
      static_cast<HelixPointOf<T>&>(point) = select<T>(met, there, point);
    }
    if (const Mask others = who & !met; any(others)) {
      Point far = point;
      this->look(far);
      ApproachOf<T> other;
      const Mask arrived = this->approach(far, wire, other, others);
      result = select(met, result, other);
      point = select(met, point, far);
      met = met | arrived;
    }
    return met;
  }

 private:
  static constexpr double share_of_tolerance = 0.1;

  struct Course {
    PathSpan<T> track;
    Point end;
    T arc, radius, cosine;  // to the end; mm, at the start; of the dip there

    friend Course select(const Mask& m, const Course& a, const Course& b) {
      return {select(m, a.track, b.track), select(m, a.end, b.end), select(m, a.arc, b.arc),
              select(m, a.radius, b.radius), select(m, a.cosine, b.cosine)};
    }
  };

  Mask none() {
    this->left_ = Mask(false);
    return Mask(false);
  }

  std::optional<Course> course_;
  Mask looked_{false}, on_course_{false}, on_wires_{false};
  typename PathSpan<T>::Place at_wires_{};
};

}  // namespace cgemit

// Motion in a non-uniform field: Runge-Kutta-Nystrom steps of fourth order.
//
// With x the position, t the direction of flight (unit vector) and l the path,
//   dx/dl = t,   dt/dl = a = bend (t x B(x)),   bend = charge/p over 10^6/c: 1/(mm T).
// A step uses the field at three points and the force in four directions (E. J. Nystroem, Acta Soc. Sci.
// Fenn. 50 no. 13 (1925); J. Myrheim and L. Bugge, Nucl. Instrum. Methods 160 (1979) 43). The field at the
// end is reused by the next step. The field in the middle is the cubic through the values and slopes at both
// ends, so that a step evaluates the field once.
#pragma once

#include <cmath>

#include "detector/field/values.hpp"
#include "motion/field_derivatives.hpp"

namespace cgemit {

template <class T>
struct FieldPoint {
  Vec3<T> x;  // mm
  Vec3<T> t;  // unit vector
  FieldValue<T> field;

  friend FieldPoint select(const mask_of<T>& m, const FieldPoint& a, const FieldPoint& b) {
    return {select<T>(m, a.x, b.x), select<T>(m, a.t, b.t), select(m, a.field, b.field)};
  }
};

template <class T>
class RungeKutta {
 public:
  explicit RungeKutta(const FieldMap& field) : field_(field) {}

  // Moves the lanes `who` along the path, backward if it is negative, and propagates `derivatives`. Returns
  // the lanes that are still inside the map; the others stop where they left it.
  mask_of<T> advance(FieldPoint<T>& point, const T& bend, const T& path, const mask_of<T>& who,
                     CarriedDerivatives<T>* derivatives) {
    mask_of<T> inside = who & field_.holds(point.x);
    T left = select(inside, path, T(0.0));
    mask_of<T> moving = inside & (left != 0.0);
    for (int steps = 0; any(moving) && steps < most_steps; ++steps) {
      const T h = select(moving, copysign(smaller(abs(left), step_), left), T(0.0));
      const mask_of<T> is_last = h == left;
      FieldStep<T> step;
      FieldPoint<T> end;
      const T square = make(point, bend, h, step, end);
      const mask_of<T> taken = moving & !adapt(h, square, is_last, moving);
      if (derivatives != nullptr && any(taken)) derivatives->take(step, taken);
      point = all(taken) ? end : select(taken, end, point);
      inside = inside & !(taken & !field_.holds(point.x));
      left = select(taken, select(is_last, T(0.0), left - h), left);
      moving = moving & inside & (left != 0.0);
    }
    return inside & !moving;
  }

 private:
  static constexpr int most_steps = 100000;
  static constexpr double most_growth = 4, shortest = 1e-3;  // mm

  // Lanes whose step was too long; sets the length of their next step. `square`: of the error, mm^2.
  mask_of<T> adapt(const T& h, const T& square, const mask_of<T>& is_last, const mask_of<T>& moving) {
    const T length = abs(h), limit(field_.tolerance * field_.tolerance);
    const mask_of<T> good = square <= limit, refused = moving & !good & (length > shortest);
    // A good last step changes nothing if the length was not limited before.
    const mask_of<T> changes = moving & !(good & is_last & (step_ == HUGE_VAL));
    if (!any(changes)) return refused;
    const mask_of<T> some = square > 0.0;
    const T growth =
        select(some, 0.9 * sqrt(sqrt(sqrt(limit / select(some, square, T(1.0))))), T(most_growth));
    const T longer = length * larger(smaller(growth, most_growth), 0.1);
    const T next = select(refused, larger(length * larger(smaller(growth, 0.9), 0.1), shortest),
                          select(is_last, larger(longer, step_), longer));
    step_ = select(changes, next, step_);
    return refused;
  }

  // Makes a step. Returns the square of its error, mm^2.
  T make(const FieldPoint<T>& from, const T& bend, const T& h, FieldStep<T>& step, FieldPoint<T>& end) const {
    const T hb = h * bend;
    const Vec3<T>&x = from.x, &t = from.t;
    const FieldValue<T>& here = from.field;
    const Vec3<T> by_path = here.slope * t;
    const Vec3<T> turn1 = cross(t, here.b), t2 = t + 0.5 * hb * turn1;
    // Estimated end point.
    const Vec3<T> guess = cross(t2, here.b + 0.5 * h * by_path);
    const Vec3<T> x4 = x + h * t + h * hb * (1.0 / 6) * (turn1 + 2.0 * guess);
    end.field = field_.at(x4);
    const Vec3<T> by_path4 = end.field.slope * (t + hb * guess);
    const Vec3<T> b2 = 0.5 * (here.b + end.field.b) + 0.125 * h * (by_path - by_path4);
    const Vec3<T> turn2 = cross(t2, b2), t3 = t + 0.5 * hb * turn2;
    const Vec3<T> turn3 = cross(t3, b2), t4 = t + hb * turn3;
    const Vec3<T> turn4 = cross(t4, end.field.b), both = turn2 + turn3;
    end.x = x + h * t + h * hb * (1.0 / 6) * (turn1 + both);
    end.t = normalized(t + hb * (1.0 / 6) * (turn1 + 2.0 * both + turn4));
    end.field.b = end.field.b + end.field.slope * (end.x - x4);
    step = {h, bend, t, end.t, here.b, end.field.b, {b2, 0.5 * (here.slope + end.field.slope)}};
    const Vec3<T> off = turn1 - both + turn4;
    return (h * hb) * (h * hb) * dot(off, off);
  }

  static Vec3<T> normalized(const Vec3<T>& v) { return 1.0 / sqrt(dot(v, v)) * v; }

  const FieldMap& field_;
  T step_{HUGE_VAL};  // mm, step allowed by the tolerance
};

}  // namespace cgemit

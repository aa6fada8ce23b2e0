// Motion of neighbouring tracks relative to a reference trajectory in a field map, by the five parameters of
// its start.
//
// A neighbour is described where it crosses the plane across the transverse flight u of the reference: by its
// distance to the left (along m, a quarter turn from u) and upward, and by the differences of azimuth, slope
// and charge/p. With s the transverse arc of the reference, w its curvature and T = d(tanl)/ds,
//   a' = psi,   psi' = dw - w^2 a,   z' = tau - tanl w a,   tau' = dT - T w a,
// where dw and dT are the changes of
//   w = bend S (tanl B_u - B_z),   T = bend S^3 B_m,   S = sec(lambda),
// by position, azimuth, slope and bend. A step is a helix for its first half, a kick with all effects that a
// helix along z does not include (slopes of the field and its components across the beam), and a helix for
// its second half. It is exact in a uniform field along z and of second order in the other effects.
#pragma once

#include <array>
#include <optional>

#include "common/compiler.hpp"
#include "detector/field/field.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// One step of a reference, as made by `RungeKutta`.
template <class T>
struct FieldStep {
  T h;               // mm, path
  T bend;            // 1/(mm T)
  Vec3<T> t1, t4;    // unit vectors, directions at its start and end
  Vec3<T> b1, b4;    // T, the field there
  FieldValue<T> b2;  // in its middle

  friend FieldStep select(const mask_of<T>& m, const FieldStep& a, const FieldStep& b) {
    return {select(m, a.h, b.h),      b.bend,
            select<T>(m, a.t1, b.t1), select<T>(m, a.t4, b.t4),
            select<T>(m, a.b1, b.b1), select<T>(m, a.b4, b.b4),
            select(m, a.b2, b.b2)};
  }
};

// The curvature of a flight in a field.
template <class T>
T curvature(const HelixPointOf<T>& point, const Vec3<T>& b, const T& bend) {
  const T sec = sqrt(1.0 + point.tanl * point.tanl);
  return bend * sec * (point.tanl * (point.ux * b.x + point.uy * b.y) - b.z);
}

// d(tanl)/ds of a flight in a field.
template <class T>
T slope_rate(const HelixPointOf<T>& point, const Vec3<T>& b, const T& bend) {
  const T square = 1.0 + point.tanl * point.tanl;
  return bend * square * sqrt(square) * (point.ux * b.y - point.uy * b.x);
}

// Derivatives of the curvature by charge/p and by tanl.
template <class T>
struct CurvatureSlopes {
  T bend, tanl;
};
// `sec`, `cosine`: of the dip.
template <class T>
CurvatureSlopes<T> curvature_slopes(const HelixPointOf<T>& at, const T& sec, const T& cosine,
                                    const Vec3<T>& b, const T& bend) {
  const T b_u = at.ux * b.x + at.uy * b.y;
  return {sec * (at.tanl * b_u - b.z),
          bend * cosine * ((1.0 + 2.0 * at.tanl * at.tanl) * b_u - at.tanl * b.z)};
}

template <class T>
struct FieldDerivatives {
  using Row = std::array<T, 5>;
  Row across, psi, bend, z, tanl;

  // Propagates along an arc of a helix.
  void drift(const T& w, const T& s, const T& slope, const CurvatureSlopes<T>& w_by) {
    const T f = w * s;
    const StepIntegral<T> turn = step_integral(f);
    const T chord = s * (1.0 - f * turn.across), versed = s * s * turn.along, sine = w * chord;
    const T cosine = 1.0 - f * f * turn.along, back = w * sine;
    const T fall = slope * sine, fall_psi = slope * w * versed, fall_w = slope * s * s * turn.across;
    for (std::size_t i = 0; i < 5; ++i) {
      const T dw = w_by.bend * bend[i] + w_by.tanl * tanl[i], a = across[i], p = psi[i];
      z[i] = z[i] + s * tanl[i] - (fall * a + fall_psi * p + fall_w * dw);
      across[i] = cosine * a + chord * p + versed * dw;
      psi[i] = cosine * p - back * a + chord * dw;
    }
  }

  // Never inlined, so that all callers round alike: a lane must not depend on the others.
  CGEMIT_NOINLINE void transport(const FieldStep<T>& step) {
    const Flight first(step.t1, step.b1, step.bend), last(step.t4, step.b4, step.bend);
    const HelixPointOf<T>&start = first.at, &end = last.at;
    const T x = start.ux + end.ux, y = start.uy + end.uy, per = 1.0 / sqrt(x * x + y * y), zero(0.0);
    HelixPointOf<T> middle{zero, zero, zero, per * x, per * y, 0.5 * (start.tanl + end.tanl), zero};
    const T cosine = 0.5 * (first.cosine + last.cosine), sec = 1.0 / cosine;
    const CurvatureSlopes<T> by1 = curvature_slopes(start, first.sec, first.cosine, step.b1, step.bend),
                             by2 = curvature_slopes<T>(middle, sec, cosine, step.b2.b, step.bend),
                             by4 = curvature_slopes(end, last.sec, last.cosine, step.b4, step.bend);
    middle.w = step.bend * by2.bend;
    const T part = step.h * (1.0 / 8), s_first = part * (3.0 * first.cosine + last.cosine),
            s_second = part * (first.cosine + 3.0 * last.cosine);
    // Parabolas through the three points, averaged over each half.
    const auto half = [](const T& outer, const T& inner, const T& beyond) {
      return (5.0 * outer + 8.0 * inner - beyond) * (1.0 / 12);
    };
    const auto halves = [&half](const CurvatureSlopes<T>& a, const CurvatureSlopes<T>& b,
                                const CurvatureSlopes<T>& c) {
      return CurvatureSlopes<T>{half(a.bend, b.bend, c.bend), half(a.tanl, b.tanl, c.tanl)};
    };
    drift(half(start.w, middle.w, end.w), s_first, middle.tanl, halves(by1, by2, by4));
    kick(step, middle, sec, s_first + s_second);
    drift(half(end.w, middle.w, start.w), s_second, middle.tanl, halves(by4, by2, by1));
  }

  // Takes a in the lanes of `m` and b in the others.
  friend FieldDerivatives select(const mask_of<T>& m, FieldDerivatives a, const FieldDerivatives& b) {
    for (Row FieldDerivatives::* row :
         {&FieldDerivatives::across, &FieldDerivatives::psi, &FieldDerivatives::bend, &FieldDerivatives::z,
          &FieldDerivatives::tanl})
      for (std::size_t i = 0; i < 5; ++i) (a.*row)[i] = select(m, (a.*row)[i], (b.*row)[i]);
    return a;
  }

 private:
  // A direction of flight, with the secant and the cosine of its dip.
  struct Flight {
    T cosine, sec;
    HelixPointOf<T> at;

    Flight(const Vec3<T>& t, const Vec3<T>& b, const T& bend)
        : cosine(sqrt(t.x * t.x + t.y * t.y)),
          sec(1.0 / cosine),
          at{T(0.0), T(0.0), T(0.0), sec * t.x, sec * t.y, sec * t.z, T(0.0)} {
      at.w = bend * sec * (at.tanl * (at.ux * b.x + at.uy * b.y) - b.z);
    }
  };

  void kick(const FieldStep<T>& step, const HelixPointOf<T>& at, const T& sec, const T& s) {
    const T &ux = at.ux, &uy = at.uy, &slope = at.tanl;
    const Vec3<T>& b = step.b2.b;
    const Mat3<T>& g = step.b2.slope;
    const T b_u = ux * b.x + uy * b.y, b_m = ux * b.y - uy * b.x;
    // Derivatives of B by position, to the left and up.
    const Vec3<T> left{ux * g.x.y - uy * g.x.x, ux * g.y.y - uy * g.y.x, ux * g.z.y - uy * g.z.x};
    const T left_u = ux * left.x + uy * left.y, left_m = ux * left.y - uy * left.x;
    const T up_u = ux * g.x.z + uy * g.y.z, up_m = ux * g.y.z - uy * g.x.z;
    const T in_plane = step.bend * sec * s;
    const T upward = sec * sec * sec * s, bent_upward = step.bend * upward;
    const T psi_a = in_plane * (slope * left_u - left.z), psi_z = in_plane * (slope * up_u - g.z.z),
            psi_psi = in_plane * slope * b_m;
    const T tanl_a = bent_upward * (left_m - at.w * b_m), tanl_z = bent_upward * up_m,
            tanl_psi = -bent_upward * b_u, tanl_tanl = 3.0 * in_plane * slope * b_m, tanl_bend = upward * b_m;
    // A kick changes the directions that it depends on; half of this change is included.
    const T more_psi = 1.0 + 0.5 * psi_psi, more_tanl = 1.0 + 0.5 * tanl_tanl, half = 0.5 * tanl_psi;
    for (std::size_t i = 0; i < 5; ++i) {
      const T by_psi = psi_a * across[i] + psi_z * z[i] + psi_psi * psi[i];
      const T by_tanl =
          tanl_a * across[i] + tanl_z * z[i] + tanl_psi * psi[i] + tanl_tanl * tanl[i] + tanl_bend * bend[i];
      psi[i] += more_psi * by_psi;
      tanl[i] += more_tanl * by_tanl + half * by_psi;
    }
  }
};

// Derivatives during one move. The last step is kept open until the end point of the move is known, so that
// small corrections of its length need no step of their own.
template <class T>
class CarriedDerivatives {
 public:
  CarriedDerivatives(FieldDerivatives<T>& by, const Vec3<T>& t, const FieldValue<T>& field, const T& bend)
      : by_(by), last_{T(0.0), bend, t, t, field.b, field.b, field} {}

  void take(const FieldStep<T>& step, const mask_of<T>& who) {
    if (const mask_of<T> now = waiting_ & who; any(now)) {
      if (!before_) before_ = by_;
      transport(now);
    }
    last_ = all(who) ? step : select(who, step, last_);
    waiting_ = waiting_ | who;
  }
  // Corrects the last step by a length h, to a point with direction t and field b, changed by `change`.
  void extend(const T& h, const Vec3<T>& t, const Vec3<T>& b, const Vec3<T>& change, const mask_of<T>& who) {
    last_.h += h;
    last_.t4 = select<T>(who, t, last_.t4);
    last_.b4 = select<T>(who, b, last_.b4);
    last_.b2.b = select<T>(who, last_.b2.b + T(0.5) * change, last_.b2.b);
    waiting_ = waiting_ | who;
  }
  // Ends the move of the lanes that arrived; the others keep the derivatives of its start.
  void finish(const mask_of<T>& arrived) {
    if (before_ && !all(arrived)) by_ = select(arrived, by_, *before_);
    if (const mask_of<T> now = waiting_ & arrived; any(now)) transport(now);
  }

 private:
  void transport(const mask_of<T>& who) {
    if (all(who)) {
      by_.transport(last_);
    } else {
      FieldDerivatives<T> moved = by_;
      moved.transport(last_);
      by_ = select(who, moved, by_);
    }
  }

  FieldDerivatives<T>& by_;
  std::optional<FieldDerivatives<T>> before_;  // at the start, if the move has more than one step
  FieldStep<T> last_;
  mask_of<T> waiting_{false};
};

}  // namespace cgemit

// The reference trajectory in a uniform field, and its derivatives by the parameters at the origin.
//
// A change of curvature dw on a piece ds'' of the path turns the rest of the path about that piece. With Z
// the quarter turn, the displacement at r(s) is
//   dr = dr0 + dpsi Z (r - r0) + Z integral dw(s'') (r(s) - r(s'')) ds''.
// Two running integrals, of the curvature's derivative and of that derivative times the position, therefore
// give every row exactly, also with energy loss, which makes the curvature depend on position and tanl. Kinks
// act on displaced tracks after the same path, not on the same cylinder: rows are off by the size of the
// kinks times the tangent of the incidence.
#pragma once

#include <cmath>

#include "common/compiler.hpp"
#include "kalman/deflection.hpp"
#include "kalman/group.hpp"
#include "motion/helix.hpp"
#include "motion/wire.hpp"

namespace cgemit {

// Displacement across the flight and along z at one point, by the parameters at the origin.
template <class T>
struct Rows {
  Five<T> across, along_z;
  T forward_d, forward_kappa,
      forward_tanl;  // displacement along the flight; its derivative by psi is `sideways`
  T sideways;        // S of the point
};

// Where a trajectory passes a wire.
template <class T>
struct Passage {
  HelixPointOf<T> at;
  Rows<T> rows;

  friend Passage select(const mask_of<T>& m, const Passage& a, const Passage& b) {
    Passage p{};
    p.at = select<T>(m, a.at, b.at);
    p.rows.across = select<T>(m, a.rows.across, b.rows.across);
    p.rows.along_z = select<T>(m, a.rows.along_z, b.rows.along_z);
    return p;
  }
};

template <class T>
class HelixMotion {
 public:
  static constexpr bool keeps_dip = true;

  HelixMotion(const Detector& detector, const PerigeeOf<T>& start)
      : per_kappa_(curvature(detector.bz, 1.0)),
        point_(closest_point(start, per_kappa_)),
        u0x_(point_.ux),
        u0y_(point_.uy),
        kappa_(start.kappa) {}

  // The same motion in all lanes, turned about the beam line.
  HelixMotion(const HelixMotion<double>& m, const SineCosine<T>& by)
      : per_kappa_(m.per_kappa_),
        kappa_(m.kappa_),
        d_kappa_(m.d_kappa_),
        d_tanl_(m.d_tanl_),
        d_dip_(m.d_dip_),
        turn_kappa_(m.turn_kappa_),
        turn_tanl_(m.turn_tanl_),
        rise_(m.rise_) {
    const auto turn = [&by](double x, double y, T& to_x, T& to_y) {
      to_x = by.cosine * x - by.sine * y;
      to_y = by.sine * x + by.cosine * y;
    };
    turn(m.point_.x, m.point_.y, point_.x, point_.y);
    turn(m.point_.ux, m.point_.uy, point_.ux, point_.uy);
    turn(m.u0x_, m.u0y_, u0x_, u0y_);
    turn(m.turn_kappa_x_, m.turn_kappa_y_, turn_kappa_x_, turn_kappa_y_);
    turn(m.turn_tanl_x_, m.turn_tanl_y_, turn_tanl_x_, turn_tanl_y_);
    point_.z = m.point_.z;
    point_.tanl = m.point_.tanl;
    point_.w = m.point_.w;
  }

  const HelixPointOf<T>& point() const { return point_; }
  const T& kappa() const { return kappa_; }

  // Moves the lanes `who`; false where the cylinder is not reached.
  CGEMIT_FLATTEN mask_of<T> go_to(const T& radius, mask_of<T> who) {
    const HelixPointOf<T> from = point_;
    T step(0.0);
    const mask_of<T> reached = step_to_cylinder(point_, radius, step, true, who);
    count(from, step);
    return reached;
  }
  mask_of<T> approach(const WireOf<T>& wire, ApproachOf<T>& result, mask_of<T> who) {
    const HelixPointOf<T> from = point_;
    const mask_of<T> met = approach_wire(point_, wire, result, who);
    count(from, result.arc);
    return met;
  }
  Passage<T> passage() const { return {point_, rows()}; }

  Rows<T> rows() const {
    const T x = point_.x, y = point_.y, ux = point_.ux, uy = point_.uy;
    const T tanl = point_.tanl;
    const T kx = turn_kappa_ * x - turn_kappa_x_, ky = turn_kappa_ * y - turn_kappa_y_;
    const T tx = turn_tanl_ * x - turn_tanl_x_, ty = turn_tanl_ * y - turn_tanl_y_;
    Rows<T> r;
    r.sideways = point_.sideways();
    r.forward_d = ux * u0y_ - uy * u0x_;
    r.forward_kappa = uy * kx - ux * ky;
    r.forward_tanl = uy * tx - ux * ty;
    r.across = {{-(ux * u0x_ + uy * u0y_), point_.outward(), ux * kx + uy * ky, T(0.0), ux * tx + uy * ty}};
    r.along_z = {{-tanl * r.forward_d, -tanl * r.sideways, -tanl * r.forward_kappa, T(1.0),
                  rise_ - tanl * r.forward_tanl}};
    return r;
  }

  // Derivatives of (d, psi, kappa, z0, tanl) with the pivot here by those at the origin, row by row.
  std::array<Five<T>, parameters> derivatives() const {
    const Rows<T> r = rows();
    const T zero(0.0);
    return {{T(-1.0) * r.across,
             Backward(*this, r).azimuth(),
             {{zero, zero, d_kappa_, zero, d_tanl_}},
             r.along_z,
             {{zero, zero, zero, zero, d_dip_}}}};
  }

  // Momentum loss: kappa grows by the factor `ratio`; its derivative by kappa is `gain`, by tanl `mixed`.
  void lose(T ratio, T gain, T mixed) {
    d_kappa_ *= gain;
    d_tanl_ = gain * d_tanl_ + mixed * d_dip_;
    kappa_ *= ratio;
    point_.w = per_kappa_ * kappa_;
  }

  // Turns the flight at fixed momentum by two angles across it: `aside` horizontally and `up`.
  void scatter(T aside, T up) {
    const Deflection<T> bent(point_.tanl, aside, up);
    bent.turn(point_);
    const T turn = bent.psi_by_tanl * d_dip_;
    turn_tanl_ += turn;
    turn_tanl_x_ += turn * point_.x;
    turn_tanl_y_ += turn * point_.y;
    d_tanl_ = bent.kappa_ratio * (d_tanl_ - kappa_ * bent.shrinks * d_dip_);
    d_kappa_ *= bent.kappa_ratio;
    d_dip_ *= bent.tanl_by_tanl;
    kappa_ *= bent.kappa_ratio;
    point_.w = per_kappa_ * kappa_;
  }

  // Parameters at the origin of a track that is displaced or turned here and whose kappa and tanl change.
  class Backward {
   public:
    Backward(const HelixMotion& m, const Rows<T>& r) : r_(r), w_(m.point_.w), d_tanl_(m.d_tanl_) {
      psi_d_ = -w_ * r.forward_d;
      psi_psi_ = 1.0 - w_ * r.sideways;
      psi_kappa_ = m.turn_kappa_ - w_ * r.forward_kappa;
      psi_tanl_ = m.turn_tanl_ - w_ * r.forward_tanl;
      const T determinant = r.across[0] * psi_psi_ - r.across[1] * psi_d_, both = m.d_kappa_ * m.d_dip_;
      const T per_all = 1.0 / (determinant * both), per_both = determinant * per_all;
      per_determinant_ = both * per_all;
      per_d_kappa_ = per_both * m.d_dip_;
      per_d_dip_ = per_both * m.d_kappa_;
    }
    // Derivatives of the azimuth here by the parameters at the origin.
    Five<T> azimuth() const { return {{psi_d_, psi_psi_, psi_kappa_, T(0.0), psi_tanl_}}; }
    // Derivatives of (d, psi, z0) by a turn in azimuth, rad, or by shifts, mm, at fixed kappa and tanl.
    std::array<T, 3> turned(T psi) const {
      const T d = -r_.across[1] * psi * per_determinant_, turn = r_.across[0] * psi * per_determinant_;
      return {d, turn, -r_.along_z[0] * d - r_.along_z[1] * turn};
    }
    std::array<T, 3> moved(T across, T along_z, T psi) const {
      const T d = (across * psi_psi_ - r_.across[1] * psi) * per_determinant_;
      const T turn = (r_.across[0] * psi - psi_d_ * across) * per_determinant_;
      return {d, turn, along_z - r_.along_z[0] * d - r_.along_z[1] * turn};
    }
    // Derivatives of all five parameters by kappa and tanl at fixed position and azimuth.
    Five<T> changed(T kappa, T tanl) const {
      const T tanl0 = tanl * per_d_dip_, kappa0 = (kappa - d_tanl_ * tanl0) * per_d_kappa_;
      const std::array<T, 3> m =
          moved(-r_.across[2] * kappa0 - r_.across[4] * tanl0,
                -r_.along_z[2] * kappa0 - r_.along_z[4] * tanl0, -psi_kappa_ * kappa0 - psi_tanl_ * tanl0);
      return {{m[0], m[1], kappa0, m[2], tanl0}};
    }
    // The same for kappa alone: (d, psi, kappa, z0).
    std::array<T, 4> slowed(T kappa) const {
      const T kappa0 = kappa * per_d_kappa_;
      const std::array<T, 3> m = moved(-r_.across[2] * kappa0, -r_.along_z[2] * kappa0, -psi_kappa_ * kappa0);
      return {m[0], m[1], kappa0, m[2]};
    }

   private:
    const Rows<T>& r_;
    T w_, d_tanl_, psi_d_, psi_psi_, psi_kappa_, psi_tanl_, per_determinant_, per_d_kappa_, per_d_dip_;
  };

 private:
  // Accounts for a step that began at `from`.
  void count(const HelixPointOf<T>& from, T step) {
    const StepIntegral<T> i = step_integral(from.w * step);
    const T square = step * step;
    const T ix = from.x * step + square * (i.along * from.ux - i.across * from.uy),
            iy = from.y * step + square * (i.along * from.uy + i.across * from.ux);
    const T by_kappa = per_kappa_ * d_kappa_, by_tanl = per_kappa_ * d_tanl_;
    turn_kappa_ += by_kappa * step;
    turn_kappa_x_ += by_kappa * ix;
    turn_kappa_y_ += by_kappa * iy;
    turn_tanl_ += by_tanl * step;
    turn_tanl_x_ += by_tanl * ix;
    turn_tanl_y_ += by_tanl * iy;
    rise_ += d_dip_ * step;
  }

  template <class>
  friend class HelixMotion;

  double per_kappa_;  // 1/mm, curvature of kappa = 1
  HelixPointOf<T> point_;
  T u0x_, u0y_, kappa_;
  // Derivatives of the local kappa by kappa and tanl at the origin, and of the local tanl by tanl there.
  T d_kappa_{1.0}, d_tanl_{0.0}, d_dip_{1.0};
  // Derivatives of the azimuth: sums, and sums times the position of the turn; of z at fixed arc, by tanl.
  T turn_kappa_{0.0}, turn_kappa_x_{0.0}, turn_kappa_y_{0.0};
  T turn_tanl_{0.0}, turn_tanl_x_{0.0}, turn_tanl_y_{0.0};
  T rise_{0.0};
};

}  // namespace cgemit

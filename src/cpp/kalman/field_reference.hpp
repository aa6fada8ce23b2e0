// The reference trajectory in a field map, for the tracer: as `HelixMotion`, one track at a time.
//
// Derivatives of place, direction and charge/p by the five parameters at the origin go along with every
// Runge-Kutta step. What a track does at one point is said by the parameters of a helix with its pivot there.
// The matrix of these by the parameters at the origin, inverted, takes noise there.
#pragma once

#include <Eigen/LU>
#include <cmath>

#include "kalman/field_local.hpp"
#include "kalman/helix_motion.hpp"

namespace cgemit {

class FieldReference {
 public:
  static constexpr bool keeps_dip = false;

  FieldReference(const Detector& detector, const Perigee& start) : motion_(detector) {
    const double cosine = std::cos(start.psi), sine = std::sin(start.psi), d = start.d;
    point_ = {d * sine, -d * cosine, start.z0, cosine, sine, start.tanl, 0};
    motion_.bend(point_, start.kappa);
    by_origin_ = derivatives_by(start);
    motion_.carry(&by_origin_);
  }
  // The motion points to the derivatives.
  FieldReference(const FieldReference&) = delete;
  FieldReference& operator=(const FieldReference&) = delete;

  const HelixPoint& point() const { return point_; }
  double kappa() const { return motion_.charge_per_p() * stretch(); }
  // Whether the map ended before the place that was asked for last.
  bool left() const { return left_; }

  bool go_to(double radius, bool who) {
    double arc = 0;
    if (!who) return false;
    const bool reached = motion_.to_cylinder(point_, radius, arc);
    left_ = left_ || motion_.left();
    return reached;
  }
  bool approach(const Wire& wire, Approach& result, bool who) {
    if (!who) return false;
    const bool met = motion_.approach(point_, wire, result);
    left_ = left_ || motion_.left();
    return met;
  }

  Rows<double> rows() const {
    Rows<double> r{};
    r.sideways = point_.sideways();
    for (int i = 0; i < parameters; ++i) {
      const auto by = by_origin_.col(i);
      r.across[i] = point_.ux * by[1] - point_.uy * by[0];
      r.along_z[i] = by[2] - point_.tanl * forward(by[0], by[1]);
    }
    return r;
  }

  // As of `HelixMotion`.
  void lose(double ratio, double gain, double mixed) {
    stay_on_cylinder();
    const double s = stretch(), share = point_.tanl / s;
    const Eigen::RowVector<double, 5> by_tanl = tanl_derivatives(point_, by_origin_);
    const double before = motion_.charge_per_p(), after = before * ratio;
    const Eigen::RowVector<double, 5> by_kappa =
        s * radius_per_kappa * by_origin_.row(6) + before * share * by_tanl;
    by_origin_.row(6) = (gain * by_kappa + (mixed - after * share) * by_tanl) / (s * radius_per_kappa);
    motion_.bend(point_, after * s);
  }

  void scatter(double aside, double up) {
    stay_on_cylinder();
    const double ux = point_.ux, uy = point_.uy, s = stretch(), c = 1 / s, sine = point_.tanl * c;
    const double norm = std::sqrt(1 + aside * aside + up * up);
    const Eigen::Vector3d u(ux, uy, 0), left(-uy, ux, 0), t = c * u + Eigen::Vector3d(0, 0, sine),
                                                          e = Eigen::Vector3d(0, 0, c) - sine * u;
    const Eigen::RowVector<double, 5> turn = s * (ux * by_origin_.row(4) - uy * by_origin_.row(3)),
                                      dip = s * by_origin_.row(5);
    by_origin_.middleRows<3>(3) -= (aside * u + up * sine * left) * turn + up * t * dip;
    by_origin_.middleRows<3>(3) /= norm;
    const Eigen::Vector3d after = (t + aside * left + up * e) / norm;
    const double transverse = std::hypot(after[0], after[1]);
    point_.ux = after[0] / transverse;
    point_.uy = after[1] / transverse;
    point_.tanl = after[2] / transverse;
    motion_.bend(point_, motion_.charge_per_p() * stretch());
  }

  // Of (d, psi, kappa, z0, tanl) with the pivot here by those at the origin, row by row.
  std::array<Five<double>, parameters> derivatives() const {
    const Eigen::Matrix<double, 5, 5> here = local_derivatives(motion_, point_, by_origin_);
    std::array<Five<double>, parameters> result;
    for (int i = 0; i < parameters; ++i)
      for (int k = 0; k < parameters; ++k) result[static_cast<std::size_t>(i)][k] = here(i, k);
    return result;
  }

  // Origin parameters of a track that is displaced or turned here and whose kappa and tanl change.
  class Backward {
   public:
    Backward(const FieldReference& m, const Rows<double>&)
        : back_(local_derivatives(m.motion_, m.point_, m.by_origin_).inverse()) {}
    Five<double> turned(double psi) const { return five(psi * back_.col(1)); }
    Five<double> moved(double across, double along_z, double psi) const {
      return five(-across * back_.col(0) + along_z * back_.col(3) + psi * back_.col(1));
    }
    Five<double> changed(double kappa, double tanl) const {
      return five(kappa * back_.col(2) + tanl * back_.col(4));
    }
    Five<double> slowed(double kappa) const { return changed(kappa, 0); }

   private:
    static Five<double> five(const Eigen::Vector<double, 5>& v) { return {{v[0], v[1], v[2], v[3], v[4]}}; }
    Eigen::Matrix<double, 5, 5> back_;
  };

 private:
  double stretch() const { return stretch_of(point_.tanl); }
  double forward(double x, double y) const { return point_.ux * x + point_.uy * y; }
  // Every displaced track loses its momentum on this cylinder, not after the same path.
  void stay_on_cylinder() {
    const double outward = point_.outward();
    const Eigen::Vector<double, 6> along = motion_.derivative_along(point_);  // per path
    by_origin_.topRows<6>() -=
        along * (point_.x * by_origin_.row(0) + point_.y * by_origin_.row(1)) * (stretch() / outward);
  }

  FieldMotion motion_;
  HelixPoint point_{};
  FieldDerivatives by_origin_;  // x, y, z, direction, bend
  bool left_ = false;
};

}  // namespace cgemit

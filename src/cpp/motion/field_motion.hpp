// Motion in a field map with the same interface as in a uniform field: to a cylinder, to the outermost point,
// to a wire. Each is a Newton iteration over Runge-Kutta steps; the helix that touches the track supplies the
// guesses.
#pragma once

#include <cmath>

#include "detector/detector.hpp"
#include "motion/helix.hpp"
#include "motion/rkn.hpp"
#include "motion/wire.hpp"

namespace cgemit {

// A helix point of this motion carries as `w` the curvature that the field has there, and its tanl changes on
// the way. An arc is the path over 1/cos(dip) where it began.
class FieldMotion {
 public:
  static constexpr bool keeps_dip = false;

  explicit FieldMotion(const FieldMap& field) : stepper_(field), field_(field) {}
  explicit FieldMotion(const Detector& detector) : FieldMotion(detector.field) {}

  // Gives a point the curvature of kappa = charge/pT, which the particle keeps as charge/p.
  void bend(HelixPoint& point, double kappa) {
    bend_ = kappa / (radius_per_kappa * std::sqrt(1 + point.tanl * point.tanl));
    const FieldPoint p = to_field(point);
    point = to_helix(p, stepper_.field(p.x));
  }
  // For derivatives that go along with every move; null: none.
  void carry(FieldDerivatives* derivatives) { derivatives_ = derivatives; }
  double bz(const HelixPoint& point) const { return field_.at(point.x, point.y, point.z)[2]; }
  double charge_per_p() const { return bend_ * radius_per_kappa; }
  // Of place and direction, by the path.
  Eigen::Vector<double, 6> derivative_along(const HelixPoint& point) const {
    const FieldPoint p = to_field(point);
    Eigen::Vector<double, 6> by_path;
    by_path << p.t, bend_ * p.t.cross(stepper_.field(p.x));
    return by_path;
  }
  // Whether the last move ended outside the map.
  bool left() const { return left_; }

  // As `step_to_cylinder`.
  [[nodiscard]] bool to_cylinder(HelixPoint& point, double r, double& arc, bool outward = true) {
    Walk walk(*this, point);
    for (int iteration = 0; iteration < most_iterations; ++iteration) {
      HelixPoint guess = walk.here;
      double step = 0;
      const bool reached = step_to_cylinder(guess, r, step, outward);
      // A cylinder below the closest approach. Where the helix turns back below one outside the track need
      // not: go on to there, and see.
      if (!reached && r < walk.here.radius()) return false;
      if (!reached) step = arc_to_apex(walk.here);
      if (!reached && !(step > close && step * std::abs(walk.here.w) < pi)) return false;
      if (!walk.go(step)) return false;
      if (reached && std::abs(walk.here.radius() - r) < exact * (1 + r)) {
        if ((walk.here.outward() >= 0) != outward) return false;
        arc = walk.finish(point);
        return true;
      }
    }
    return false;
  }

  // To the outermost point ahead.
  bool to_apex(HelixPoint& point, double& arc) {
    Walk walk(*this, point);
    double step = arc_to_apex(point);
    for (int iteration = 0; iteration < most_iterations; ++iteration) {
      if (!std::isfinite(step) || !walk.go(step)) return false;
      if (std::abs(step) < close) break;
      // The turn ahead or behind after which P vanishes.
      const double along = 1 - walk.here.w * walk.here.sideways(), p = walk.here.outward() / along;
      step = -p * atan_over(walk.here.w * p);
    }
    arc = walk.finish(point);
    return true;
  }

  // To the closest approach to the beam line, less than half a turn away.
  bool to_perigee(HelixPoint& point) {
    Walk walk(*this, point);
    for (int iteration = 0; iteration < most_iterations; ++iteration) {
      const HelixPoint& p = walk.here;
      const double turn = std::atan2(p.w * p.outward(), 1 - p.w * p.sideways());
      const double step = p.w == 0 ? -p.outward() : -turn / p.w;
      if (!walk.go(step)) return false;
      if (std::abs(step) < exact) {
        walk.finish(point);
        return true;
      }
    }
    return false;
  }

  // As `approach_wire`.
  [[nodiscard]] bool approach(HelixPoint& point, const Wire& wire, Approach& result) {
    Walk walk(*this, point);
    for (int iteration = 0; iteration < most_iterations; ++iteration) {
      HelixPoint guess = walk.here;
      if (!approach_wire(guess, wire, result)) return false;
      const double step = result.arc;
      if (!walk.go(step)) return false;
      if (std::abs(step) < close) {
        result.arc = walk.finish(point);
        return true;
      }
    }
    return false;
  }

 private:
  static constexpr int most_iterations = 20;
  // mm; what is left along the track changes a distance by its square only, a place by itself.
  static constexpr double close = 1e-5, exact = 1e-12;
  static constexpr double short_step = 3e-3;  // mm; shorter ones need no more than the curvature

  // Steps along the track; nothing counts before `finish`.
  struct Walk {
    FieldMotion& motion;
    HelixPoint here;
    FieldPoint start, at;
    Eigen::Vector3d b;  // field at the end of the last long step
    double path = 0;

    Walk(FieldMotion& m, const HelixPoint& point)
        : motion(m), here(point), start(m.to_field(point)), at(start), b(0, 0, 0) {
      m.left_ = false;
    }
    bool go(double arc) {
      const double step = arc * std::sqrt(1 + here.tanl * here.tanl);
      if (path != 0 && std::abs(step) < short_step) {
        const Eigen::Vector3d turn = at.bend * at.t.cross(b);
        at.x += step * at.t + 0.5 * step * step * turn;
        at.t = (at.t + step * turn).normalized();
      } else {
        motion.left_ = !motion.stepper_.advance(at, step);
        b = motion.stepper_.field(at.x);
      }
      path += step;
      here = to_helix(at, b);
      return !motion.left_;
    }
    // Derivatives need one journey only.
    double finish(HelixPoint& point) {
      if (motion.derivatives_ != nullptr)
        motion.left_ = !motion.stepper_.advance(start, path, motion.derivatives_);
      const double arc = path / std::sqrt(1 + point.tanl * point.tanl);
      point = here;
      return arc;
    }
  };

  FieldPoint to_field(const HelixPoint& p) const {
    const double cosine = 1 / std::sqrt(1 + p.tanl * p.tanl);
    return {{p.x, p.y, p.z}, {cosine * p.ux, cosine * p.uy, cosine * p.tanl}, bend_};
  }

  static HelixPoint to_helix(const FieldPoint& p, const Eigen::Vector3d& b) {
    const double t = std::sqrt(p.t[0] * p.t[0] + p.t[1] * p.t[1]), ux = p.t[0] / t, uy = p.t[1] / t,
                 tanl = p.t[2] / t;
    return {p.x[0], p.x[1], p.x[2], ux, uy, tanl, p.bend / t * (tanl * (ux * b[0] + uy * b[1]) - b[2])};
  }

  RungeKutta stepper_;
  const FieldMap& field_;
  double bend_ = 0;
  FieldDerivatives* derivatives_ = nullptr;
  bool left_ = false;
};

}  // namespace cgemit

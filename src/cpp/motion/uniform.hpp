// Motion in a uniform field, as the simulation and the fit ask for it; see `motion/field_motion.hpp` for the
// other one.
#pragma once

#include "detector/detector.hpp"
#include "motion/helix.hpp"
#include "motion/wire.hpp"

namespace cgemit {

class UniformMotion {
 public:
  static constexpr bool keeps_dip = true;

  explicit UniformMotion(const Detector& detector) : bz_(detector.bz) {}

  // Gives a point the curvature of kappa = charge/pT.
  void bend(HelixPoint& point, double kappa) const { point.w = curvature(bz_, kappa); }
  double bz(const HelixPoint&) const { return bz_; }
  bool to_cylinder(HelixPoint& point, double r, double& arc, bool outward = true) const {
    return step_to_cylinder(point, r, arc, outward);
  }
  void to_apex(HelixPoint& point, double& arc) const {
    arc = arc_to_apex(point);
    advance(point, arc);
  }
  bool approach(HelixPoint& point, const Wire& wire, Approach& result) const {
    return approach_wire(point, wire, result);
  }
  static constexpr bool left() { return false; }

 private:
  double bz_;
};

}  // namespace cgemit

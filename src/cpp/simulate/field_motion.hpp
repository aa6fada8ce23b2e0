// A field map's motion with masks.
#pragma once

#include "motion/field_motion.hpp"

namespace cgemit {

template <class T>
class FieldMotionOf : FieldMotion {
 public:
  static constexpr bool keeps_dip = false;
  using Point = HelixPoint;
  using FieldMotion::bz, FieldMotion::FieldMotion, FieldMotion::left;

  void look(HelixPoint&) {}
  void bend(HelixPoint& point, double kappa, bool who) {
    if (who) FieldMotion::bend(point, kappa);
  }
  bool to_cylinder(HelixPoint& point, double r, double& arc, bool outward, bool who) {
    return who && FieldMotion::to_cylinder(point, r, arc, outward);
  }
  void to_apex(HelixPoint& point, double& arc, bool who) {
    if (who) FieldMotion::to_apex(point, arc);
  }
  bool approach(HelixPoint& point, const Wire& wire, Approach& result, bool who) {
    return who && FieldMotion::approach(point, wire, result);
  }
};

}  // namespace cgemit

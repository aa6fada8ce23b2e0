// Motion in a uniform field with the interface of the simulation; `motion/field_ahead.hpp` is for field maps.
#pragma once

#include "detector/detector.hpp"
#include "motion/helix.hpp"
#include "motion/wire.hpp"

namespace cgemit {

// Each function acts on the lanes `who`; the others stay where they are.
template <class T>
class UniformMotionOf {
 public:
  using Mask = mask_of<T>;
  using Point = HelixPointOf<T>;
  static constexpr bool keeps_dip = true;

  explicit UniformMotionOf(const Detector& detector) : bz_(detector.bz) {}

  void look(Point&) const {}
  // Flies the same helix in the opposite direction from here on.
  void reverse(Point& point) const { point = reversed(point); }
  // Sets the curvature of points from kappa = charge/pT.
  void bend(Point& point, const T& kappa, const Mask& who) const {
    point.w = select(who, curvature(bz_, kappa), point.w);
  }
  T bz(const Point&) const { return T(bz_); }
  Mask to_cylinder(Point& point, const T& r, T& arc, bool outward, const Mask& who) const {
    return step_to_cylinder(point, r, arc, outward, who);
  }
  void to_apex(Point& point, T& arc, const Mask& who) const {
    arc = select(who, arc_to_apex(point), T(0.0));
    advance(point, arc);
  }
  // Moves by an arc, forward or backward.
  void along(Point& point, const T& arc) const { advance(point, arc); }
  // Matter and wires on the way are met one by one: a step costs as little as what a look ahead would save.
  Mask to_slab(Point& point, double radius, T& arc, const Mask& who) const {
    return step_to_cylinder(point, T(radius), arc, true, who);
  }
  Mask to_wires(Point& point, const T& radius, T& arc, const Mask& who) const {
    return step_to_cylinder(point, radius, arc, true, who);
  }
  Mask approach_near(Point& point, const WireOf<T>& wire, ApproachOf<T>& result, const Mask& who) const {
    return approach_wire(point, wire, result, who);
  }
  static Mask left() { return Mask(false); }

 private:
  double bz_;
};

}  // namespace cgemit

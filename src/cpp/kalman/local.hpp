// A helix with its covariance at any pivot, moved through field and matter.
#pragma once

#include "common/status.hpp"
#include "detector/detector.hpp"
#include "kalman/trajectory.hpp"
#include "matter/track.hpp"
#include "motion/helix.hpp"
#include "motion/wire.hpp"

namespace cgemit {

struct LocalState {
  double x, y, z;  // mm, the pivot
  Perigee helix;
  Matrix5 c;  // of (d, psi, kappa, z0, tanl)
};

// The point of the helix that is closest to its pivot. `per_kappa`: curvature for kappa = 1; 0: not asked
// for.
HelixPoint point_of(const LocalState& state, double per_kappa);

// Derivatives of (d, psi, kappa, z0, tanl) at one pivot by those at another, the closest points being a
// transverse arc apart. With theta = w s the turn between them, the circle's centre stays where it is:
// (d' + R) e(phi0 + theta) + pivot' = (d + R) e(phi0) + pivot, z0' = z0 + s tanl + (z of the pivots), R =
// -1/w; written without R, so that a straight line is nothing special.
Matrix5 pivot_jacobian(const Perigee& from, double d_to, double arc, double per_kappa);

// The same helix at another pivot, its closest point less than half a turn away. False, leaving the state
// alone, in the middle of the circle, which has no closest point.
[[nodiscard]] bool change_pivot(LocalState& state, double x, double y, double z, double per_kappa);

// Moves the pivot of a state along its track: an exact helix in a uniform field; in any other Runge-Kutta
// steps, whose derivatives take the covariance along. The state stays as it is unless all is well.
class LocalMotion {
 public:
  explicit LocalMotion(const Detector& detector)
      : field_(detector.field), per_kappa_(curvature(detector.bz, 1.0)) {}

  // To the point that is closest to the pivot.
  [[nodiscard]] StateStatus to_track(LocalState& state) const;
  // To where the track leaves a cylinder.
  [[nodiscard]] StateStatus to_cylinder(LocalState& state, double radius) const;
  // To the closest approach to a wire.
  [[nodiscard]] StateStatus to_wire(LocalState& state, const Wire& wire) const;
  // 1/mm, turning per transverse arc of a track with this kappa, on its flight through a point.
  double turning(const HelixPoint& point, double kappa) const;

 private:
  template <class Move>
  StateStatus integrate(LocalState& state, const Move& move) const;

  const FieldMap& field_;
  double per_kappa_;  // curvature for kappa = 1 in a uniform field
};

// What a state needs to be propagated: the particle's mass, the field and the matter.
struct PropagationContext {
  double mass;
  TrackMatter matter;
  LocalMotion motion;
};

// Crosses a part of a slab at the pivot, on the way out, or back in: then it regains energy. `noise`: what
// the matter does at random joins the covariance. False if the particle stops.
[[nodiscard]] bool cross(LocalState& state, const Slab& slab, double part, const PropagationContext& context,
                         bool outward, bool noise);

// Goes to a radius and crosses a part of a slab there, with its noise, unless the slab ends before.
[[nodiscard]] StateStatus traverse(LocalState& state, double radius, const Slab& slab, double part,
                                   const PropagationContext& context, bool outward);

}  // namespace cgemit

// A helix with its covariance at any pivot, moved through field and matter.
#pragma once

#include "common/status.hpp"
#include "detector/detector.hpp"
#include "kalman/trajectory.hpp"
#include "matter/track.hpp"
#include "motion/helix.hpp"

namespace cgemit {

struct LocalState {
  double x, y, z;  // mm, the pivot
  Perigee helix;
  Matrix5 c;  // of (d, psi, kappa, z0, tanl)
  // GeV/c, momentum here with which the track scatters and loses energy, where kappa does not measure it; 0:
  // that of kappa.
  double matter_p = 0;
};

// The point of the helix that is closest to its pivot. `per_kappa`: curvature for kappa = 1; 0 if the
// curvature is not needed.
HelixPoint point_of(const LocalState& state, double per_kappa);

// Derivatives of (d, psi, kappa, z0, tanl) at one pivot by those at another; `arc` is the transverse arc
// between the two closest points. With theta = w s the turn between them, the circle's centre is fixed: (d' +
// R) e(phi0 + theta) + pivot' = (d + R) e(phi0) + pivot, z0' = z0 + s tanl + (z of the pivots), R = -1/w. The
// formulas are written without R, so that they hold for a straight line, too.
Matrix5 pivot_jacobian(const Perigee& from, double d_to, double arc, double per_kappa);

// The same helix at another pivot, its closest point less than half a turn away. Returns false and leaves the
// state unchanged if the pivot is the centre of the circle, which has no closest point.
[[nodiscard]] bool change_pivot(LocalState& state, double x, double y, double z, double per_kappa);

// Moves the pivot of a state along its track: an exact helix in a uniform field, Runge-Kutta steps in any
// other field, whose derivatives transport the covariance. On failure the state is unchanged.
class LocalMotion {
 public:
  explicit LocalMotion(const Detector& detector)
      : field_(detector.field), per_kappa_(curvature(detector.bz, 1.0)) {}

  // To the point of the track that is closest to the pivot.
  [[nodiscard]] StateStatus to_track(LocalState& state) const;
  // To the point where the track leaves a cylinder.
  [[nodiscard]] StateStatus to_cylinder(LocalState& state, double radius) const;
  // To the point of closest approach to a wire.
  [[nodiscard]] StateStatus to_wire(LocalState& state, const Wire& wire) const;
  // 1/mm, turning per transverse arc of a track with this kappa that flies through a point.
  double turning(const HelixPoint& point, double kappa) const;

 private:
  template <class Move>
  StateStatus integrate(LocalState& state, const Move& move) const;

  const FieldMap& field_;
  double per_kappa_;  // curvature for kappa = 1 in a uniform field
};

// The context of a propagation: the particle's mass and unsigned charge, the field and the matter.
struct PropagationContext {
  double mass, charge;
  TrackMatter matter;
  LocalMotion motion;
};

// Crosses a part of a slab at the pivot, outward, or inward with a gain of energy. `noise`: whether the
// random effects of the matter are added to the covariance. False if the particle stops.
[[nodiscard]] bool cross(LocalState& state, const Slab& slab, double part, const PropagationContext& context,
                         bool outward, bool noise);

// Moves to a radius and crosses a part of a slab there, with its noise, if the track is within its length.
[[nodiscard]] StateStatus traverse(LocalState& state, double radius, const Slab& slab, double part,
                                   const PropagationContext& context, bool outward);

}  // namespace cgemit

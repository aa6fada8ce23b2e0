// A helix with its covariance at any pivot, moved through field and matter.
#pragma once

#include "common/status.hpp"
#include "detector/detector.hpp"
#include "kalman/way.hpp"
#include "matter/track.hpp"
#include "motion/helix.hpp"

namespace cgemit {

struct LocalState {
  double x, y, z;  // mm, the pivot
  Perigee helix;
  Matrix5 c;  // of (d, psi, kappa, z0, tanl)
};

// The point of the helix that is closest to its pivot. `per_kappa`: curvature for kappa = 1.
HelixPoint point_of(const LocalState& state, double per_kappa);

// Derivatives of (d, psi, kappa, z0, tanl) at one pivot by those at another, the closest points being a
// transverse arc apart. With theta = w s the turn between them, the circle's centre stays where it is:
// (d' + R) e(phi0 + theta) + pivot' = (d + R) e(phi0) + pivot, z0' = z0 + s tanl + (z of the pivots), R =
// -1/w; written without R, so that a straight line is nothing special.
Matrix5 pivot_jacobian(const Perigee& from, double d_to, double arc, double per_kappa);

// The same helix at another pivot, its closest point less than half a turn away. False, leaving the state
// alone, in the middle of the circle, which has no closest point.
[[nodiscard]] bool change_pivot(LocalState& state, double x, double y, double z, double per_kappa);

// To a point of the helix itself, an arc ahead or (negative) behind.
void move_to(LocalState& state, const HelixPoint& to, double arc, double per_kappa);

// To where the helix leaves a cylinder. False, leaving the state alone, if it does not reach it.
[[nodiscard]] bool move_to_cylinder(LocalState& state, double radius, double per_kappa);

// What flies, and through what field and matter.
struct Traveller {
  double mass;
  TrackMatter matter;
  double per_kappa;  // curvature for kappa = 1
};

// Crosses a part of a slab at the pivot, on the way out, or back in: then it regains energy. `noise`: what
// the matter does at random joins the covariance. False if the particle stops.
[[nodiscard]] bool cross(LocalState& state, const Slab& slab, double part, const Traveller& who, bool outward,
                         bool noise);

// Goes to a radius and crosses a part of a slab there, with its noise, unless the slab ends before.
[[nodiscard]] StateStatus traverse(LocalState& state, double radius, const Slab& slab, double part,
                                   const Traveller& who, bool outward);

}  // namespace cgemit

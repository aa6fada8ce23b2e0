// The two views of a chamber of stereo wires, one of each sign of the stereo angle.
//
// A wire turns about the beam line by t z, with t = tan(twist/2)/half length. Where it is at z = 0 it has,
// seen along a helix, the azimuth phi - t z: nearly a circle, since z grows linearly with the arc. Two
// circles, one of each view, give the azimuth and the height of the helix at each radius.
#pragma once

#include <optional>

#include "detector/detector.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// 1, -1, or 0 for axial wires.
inline int stereo_sign(const WireLayer& layer) { return layer.twist > 0 ? 1 : layer.twist < 0 ? -1 : 0; }

// A circle through three points, flown through from the first to the last.
HelixPoint circle_through(double ax, double ay, double bx, double by, double cx, double cy);
// The arc of a circle with this curvature over a chord, less than half a turn.
double arc_of(double w, double chord);

struct ViewCircle {
  double d, psi, w;  // as in `Perigee`; 1/mm
};
struct ViewHelix {
  double d, psi, w, z0, tanl;
  double off;  // mm, largest distance of a height between the circles from the line in z
};

// The helix of the circles of positive and negative twist, compared between two radii. None: they do not both
// reach three of the radii in between.
std::optional<ViewHelix> helix_of_views(const Detector& detector, const ViewCircle& positive,
                                        const ViewCircle& negative, double from, double to);

}  // namespace cgemit

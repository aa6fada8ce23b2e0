// GEM foils as a lattice of holes: what a track really crosses.
//
// The frame of a foil: u along r phi, v along z, w outward from its middle, all in mm. Holes stand in a
// hexagonal lattice with a row along u; the curvature of the foil over the width of a hole is neglected.
#pragma once

#include "common/rng.hpp"
#include "detector/detector.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// A straight line through the foil: where it crosses the middle, and its slopes.
struct FoilLine {
  double u, v;              // mm
  double slope_u, slope_v;  // du/dw, dv/dw
};

// The part (0 to 1) of the line's way through the slab that lies beside the holes. Exact; lines so flat that
// they pass some hundred holes get the mean.
double solid_fraction(const Holes& holes, const FoilLine& line);

// The same for a particle at a slab with holes. Where among the holes it crosses a foil is drawn for each
// particle and foil: nobody knows how a foil lies to a fraction of a millimetre, and so the mean over
// particles is that of the whole foil wherever they come from.
double fraction_beside_holes(const Slab& slab, const HelixPoint& point, const Stream& stream);

}  // namespace cgemit

// GEM foils as a lattice of holes, for the exact matter that a track crosses.
//
// The frame of a foil: u along r phi, v along z, w outward from its middle, all in mm. Holes form a hexagonal
// lattice with a row along u; the curvature of the foil over the width of a hole is neglected.
#pragma once

#include "common/rng.hpp"
#include "detector/detector.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// A straight line through the foil: its point in the middle of the foil, and its slopes.
struct FoilLine {
  double u, v;              // mm
  double slope_u, slope_v;  // du/dw, dv/dw
};

// Fraction (0 to 1) of the line's path through the slab that is outside the holes. Exact; lines so inclined
// that they cross some hundred holes get the mean.
double solid_fraction(const Holes& holes, const FoilLine& line);

// The same for a particle at a slab with holes. The crossing point relative to the holes is drawn for each
// particle and foil, because the position of a foil is not known to a fraction of a millimetre. The mean over
// particles is therefore the mean of the whole foil, for any origin of the particles.
double fraction_beside_holes(const Slab& slab, const HelixPoint& point, const Stream& stream);

}  // namespace cgemit

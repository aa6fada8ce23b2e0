// Random passage of a particle through a slab.
#pragma once

#include <cmath>

#include "common/rng.hpp"
#include "matter/moments.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// Energy lost in a slab, GeV: collisions above a cut one by one from the 1/E^2 spectrum up to w_max, softer
// ones by their mean and variance. The cut is where `hard_collisions` are expected, so that the soft part is
// nearly Gaussian. The mean is Bethe's, the shape Landau's (Vavilov's for slow particles), and two halves of
// a slab sum to the whole.
double sample_loss(const Slab& slab, double path, const Kinematics& k, const Stream& stream,
                   std::uint32_t place);

// Turns the flight direction by plane angles (radians, small) about the two axes across it, and shifts the
// point along them. Axis 1 is horizontal (in the transverse plane), axis 2 completes a right-handed set with
// the flight.
struct Kick {
  double angle_1, angle_2, shift_1, shift_2;
};
void apply_kick(HelixPoint& point, const Kick& kick);

}  // namespace cgemit

// Energy-loss correction of the first helix: slow particles curve more and more on their way outward.
#pragma once

#include "detector/detector.hpp"
#include "matter/kinematics.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// Follows a helix that is valid at `radius` back to the closest approach to the beam line, with the energy
// loss in the matter between. If the mean loss changes the helix by less than a hundredth, the helix is
// returned unchanged.
Perigee before_loss(const Detector& detector, const Perigee& helix, double radius, const Species& species);

}  // namespace cgemit

// The helix at the origin of a particle that has another one farther out: it was faster before the matter.
#pragma once

#include "detector/detector.hpp"
#include "matter/kinematics.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// c/GeV; of slower particles, the loss matters.
inline constexpr double slow_kappa = 8;

// `helix`: that of the particle at `radius` mm, as if it had lost nothing.
Perigee trace_back(const Detector& detector, const Perigee& helix, double radius, const Species& species);

}  // namespace cgemit

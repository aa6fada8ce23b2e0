// A helix at the origin from a point of the track farther out: the particle was faster before the matter.
#pragma once

#include "detector/detector.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// c/GeV; of slower particles, the loss matters.
inline constexpr double slow_kappa = 8;

Perigee trace_back(const Detector& detector, HelixPoint at, double mass);

}  // namespace cgemit

// A helix at the origin from a point of the track farther out: the particle was faster before the matter.
#pragma once

#include "detector/detector.hpp"
#include "motion/helix.hpp"

namespace cgemit {

Perigee trace_back(const Detector& detector, HelixPoint at, double mass);

}  // namespace cgemit

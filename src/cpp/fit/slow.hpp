// Slow particles bend ever more on their way out: what a circle through their hits says about the origin.
#pragma once

#include "detector/detector.hpp"
#include "kalman/reference.hpp"

namespace cgemit {

// Follows a helix that holds at `radius` back to the closest approach to the beam line, with the energy that
// the matter in between takes. What the mean loss does not change by a hundredth is returned as it is.
Perigee before_loss(const Detector& detector, const Perigee& helix, double radius, double mass);

}  // namespace cgemit

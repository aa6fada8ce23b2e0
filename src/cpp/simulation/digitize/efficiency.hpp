// Crossings that a layer sees, whatever its readout.
#pragma once

#include <cstdint>
#include <span>

#include "detector/detector.hpp"
#include "simulation/digitize/truths.hpp"

namespace cgemit {

// Whether each crossing is seen, with the probability of its layer, for both views together.
void seen_crossings(const Detector& detector, const TruthColumns& truths, std::span<const double> efficiency,
                    std::uint64_t seed, std::span<bool> seen);

}  // namespace cgemit

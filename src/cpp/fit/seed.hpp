// A first helix from the drift-chamber hits alone: circle through the axial wires, line through the stereo
// wires.
#pragma once

#include <optional>
#include <span>

#include "kalman/reference.hpp"

namespace cgemit {

// `sides` (+1, -1, or 0 unknown), one per hit, move the points from the wire to the track where known.
// Empty if fewer than three axial or two stereo wires fired, or if no circle goes through them.
std::optional<Perigee> seed_from_wires(const Detector& detector, std::span<const Hit> hits,
                                       std::span<const std::int8_t> sides);

}  // namespace cgemit

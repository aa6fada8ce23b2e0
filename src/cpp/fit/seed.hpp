// A first helix from the hits: circle through the axial wires, line through the stereo wires, with or without
// the CGEM clusters; or a track from the beam line through the azimuths of all wires.
#pragma once

#include <optional>
#include <span>

#include "kalman/group.hpp"

namespace cgemit {

// What the first helix is drawn through.
enum class SeedFrom {
  wires,               // the drift chamber alone
  wires_and_clusters,  // also the CGEM clusters: for tracks that leave too few wires, or whose wires mislead
  azimuths             // all wires at once, axial or not, for a track from the beam line
};

struct Seed {
  Perigee helix;
  double spread;  // mm, by how much most hits miss it in the transverse plane; infinite if it does not know
};

// `sides` (+1, -1, or 0 unknown), one per hit, move the points from the wire to the track where known.
// Empty if there are fewer than three points for the circle or two for the line (azimuths: five wires), or if
// no helix goes through them.
std::optional<Seed> seed_helix(const Detector& detector, std::span<const Hit> hits,
                               std::span<const std::int8_t> sides, SeedFrom from, double mass);

}  // namespace cgemit

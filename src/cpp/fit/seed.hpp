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
  wires_and_clusters,  // also the CGEM clusters
  azimuths             // all wires at once, axial or not, for a track from the beam line
};

struct Seed {
  Perigee helix;
  double spread;  // mm, by how much most hits miss it in the transverse plane; infinite if it does not know
};

// The helix that most of the hits agree on; others may be wrong. `sides` (+1, -1, or 0 unknown), one per hit,
// say where the track passes the wire. `mass` (GeV) puts back what a slow particle has lost on its way to the
// hits. Empty if there are fewer than three points for the circle or two for the line (azimuths: five wires),
// or if no helix goes through them.
std::optional<Seed> seed_helix(const Detector& detector, std::span<const Hit> hits,
                               std::span<const std::int8_t> sides, SeedFrom from, double mass);

}  // namespace cgemit

// A first helix from the hits. Either a circle through the axial wires and a line through the stereo wires,
// with or without the CGEM clusters; or a track from the beam line through the azimuths of all wires, moved
// to their drift circles and the CGEM clusters.
#pragma once

#include <optional>
#include <span>

#include "kalman/group.hpp"

namespace cgemit {

// The hits used for the first helix.
enum class SeedFrom {
  wires,               // the drift chamber alone
  wires_and_clusters,  // the drift chamber and the CGEM clusters
  azimuths             // all wires at once, axial or stereo, then all hits, for a track from the beam line
};

struct Seed {
  Perigee helix;
  double spread;  // mm, distance of most hits from it in the transverse plane; infinite if unknown
};

// The helix that agrees with most of the hits; the others may be wrong. `sides` (+1, -1, or 0 unknown), one
// per hit, is the side on which the track passes the wire. `mass` (GeV) and `charge` (e, unsigned) are used
// to correct for the energy that a slow particle has lost before the hits. Without a field kappa is that of
// `momentum` (GeV/c) and of a positive charge. Empty if there are fewer than three points for the circle or
// two for the line (azimuths: five wires), or if no helix goes through them.
std::optional<Seed> seed_helix(const Detector& detector, std::span<const Hit> hits,
                               std::span<const std::int8_t> sides, SeedFrom from, double mass, double charge,
                               double momentum);

}  // namespace cgemit

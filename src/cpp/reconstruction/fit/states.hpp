// States of fitted tracks anywhere along the track: smoothed between the measurements, extrapolated beyond.
#pragma once

#include <cstdint>
#include <span>
#include <tuple>
#include <vector>

#include "common/columns.hpp"
#include "common/status.hpp"
#include "kalman/local.hpp"
#include "kalman/smoother.hpp"
#include "kalman/used_hit.hpp"

namespace cgemit {

enum class StateSurface : std::int8_t { origin = 0, beam_line = 1, cylinder = 2, hit = 3 };

// The surface of a requested state.
struct Target {
  StateSurface surface;
  double radius;  // mm, of a cylinder
  double share;   // part of the slab cut by the cylinder that lies inside it

  static constexpr auto columns() {
    return std::tuple(Column("surface", &Target::surface), Column("radius", &Target::radius),
                      Column("share", &Target::share));
  }
};

struct TrackState {
  StateStatus status;
  std::int32_t hit;  // -1: not at a hit
  LocalState state;
  double residual, variance;  // mm, of a hit relative to this state; variance 0: none
};

// A fitted track: the helix about which its last iteration was linearised, and the measurements it used.
struct FittedTrack {
  std::span<const Hit> hits;
  std::span<const UsedHit> used;
  Perigee reference;
  std::span<const double> kinks;  // of the helix, two angles for every slab
  Matrix5 prior;                  // of the filter
  double mass, charge;            // GeV; e, unsigned
  double matter_p;                // GeV/c, momentum in matter at the origin; 0: that of the helix
};

// Work space of a thread.
struct StateSpace {
  ReferenceTrajectory trajectory;
  std::vector<OriginState> inward, smoothed;
};

// Appends one state for every target; for targets at the hits, one per hit.
void fitted_states(const Detector& detector, const FittedTrack& track, std::span<const Target> targets,
                   StateSpace& space, std::vector<TrackState>& out);

// Moves a state to a cylinder, outward or inward, and adds the noise of the matter between. The slab in which
// the state begins is crossed from `from` on, and the slab of the target up to `to` (shares as in Target).
StateStatus extrapolate(const Detector& detector, LocalState& state, double mass, double charge,
                        double radius, double from, double to);

}  // namespace cgemit

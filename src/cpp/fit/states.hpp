// Fitted tracks anywhere on their way: smoothed states between the measurements, extrapolated ones beyond.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "common/status.hpp"
#include "kalman/local.hpp"
#include "kalman/smoother.hpp"

namespace cgemit {

enum class Surface : std::int8_t { origin = 0, beam_line = 1, cylinder = 2, hit = 3 };

// Where a state is asked for.
struct Target {
  Surface surface;
  double radius;  // mm, of a cylinder
  double share;   // of the slab that the cylinder cuts: what lies inside
};

// One measurement as the last iteration of the fit used it.
struct Used {
  bool used;        // not an outlier
  double value;     // mm, signed
  double variance;  // mm^2
};

struct TrackState {
  StateStatus status;
  std::int32_t hit;  // -1: not at a hit
  LocalState state;
  double residual, variance;  // mm, of a hit to this state; variance 0: there is none
};

// A fitted track: the helix about which its last iteration was linearised, and what it used.
struct FittedTrack {
  std::span<const Hit> hits;
  std::span<const Used> used;
  Perigee reference;
  std::span<const double> kinks;  // of it, two angles for every slab
  Matrix5 prior;                  // what its filter began with
  double mass;
};

// Work space of a thread.
struct StateSpace {
  ReferenceTrajectory trajectory;
  std::vector<OriginState> inward, smoothed;
};

// Appends one state for every target, for the hits as many as there are.
void fitted_states(const Detector& detector, const FittedTrack& track, std::span<const Target> targets,
                   StateSpace& space, std::vector<TrackState>& out);

// Moves a state to a cylinder through the matter on the way, outward or back in, whose noise it collects. The
// slab in which it begins is taken from `from` on, and that of the target as far as `to` (shares as in
// Target).
StateStatus extrapolate(const Detector& detector, LocalState& state, double mass, double radius, double from,
                        double to);

}  // namespace cgemit

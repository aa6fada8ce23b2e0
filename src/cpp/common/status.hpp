// The final status of a row. The Python enums are built from these, so that there is only one list.
#pragma once

#include <cstdint>

namespace cgemit {

// How the simulation of a particle ended.
enum class TransportStatus : std::int8_t {
  outside = 0,     // left through the outermost cylinder
  end = 1,         // left through an end
  curled = 2,      // turned back towards the axis
  stopped = 3,     // lost all its energy in material
  neutral = 4,     // no charge; not transported
  left_field = 5,  // reached the edge of the field map
  decayed = 6,     // decayed in flight
  // Not transported:
  at_rest = 7,      // no momentum
  out_of_range = 8  // starts beyond 1 km, or above 1e6 GeV/c
};

// How the fit of a track ended.
enum class FitStatus : std::int8_t {
  ok = 0,
  too_few_hits = 1,           // no more measurements than parameters
  seed_failed = 2,            // no helix through the hits to start from
  does_not_reach = 3,         // the reference helix meets fewer than six of the hits
  stopped = 4,                // the reference momentum is used up in material before a hit
  not_converged = 5,          // still moving after the last allowed iteration
  not_positive_definite = 6,  // the covariance is not a valid covariance of real parameters
  left_field = 7,             // the reference leaves the field map before the last hit
  // the error of the momentum exceeds half of it, or of the one given in matter; or the error of d_z or
  // tan(lambda) exceeds half of that of the filter's prior
  unconstrained = 8,
  hits_left_out = 9,  // more hits are left out than used
  large_chi2 = 10     // chi-square that neither chance nor the errors of the hits explain; set by fit.py
};

// Whether a fitted track has a state at a requested surface.
enum class StateStatus : std::int8_t {
  ok = 0,
  not_fitted = 1,  // the fit of the track has not converged
  // the cylinder lies inside the track's closest approach or beyond its turning point
  does_not_reach = 2,
  stopped = 3,    // the particle stops before the surface
  left_field = 4  // the field map ends before the surface
};

}  // namespace cgemit

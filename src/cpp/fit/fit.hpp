// Track fit: Kalman filter from the outermost hit inward to the origin, linearised about a reference that is
// renewed until it stops moving.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "common/status.hpp"
#include "kalman/reference.hpp"

namespace cgemit {

// Values live in `cgemit.fit.FitSettings`.
struct FitSettings {
  int max_iterations;
  double
      tolerance;  // the reference has stopped when every parameter moves by less, in its standard deviation
  bool errors_from_track;  // cluster errors from size and the track's incidence, else from the cluster's own
                           // table
  double least_width;      // smallest spread of a cluster's position, in pitches
  double delta_strips;     // probability that a delta electron adds one strip to a cluster; 0: none does
  std::array<double, 5> prior_sigma;  // of d, psi, kappa, z0, tanl: weak, for the filter to begin with
};

struct FitResult {
  FitStatus status;
  Perigee helix;
  Matrix5 covariance;  // of (dr, phi0, kappa, dz, tanl)
  double chi2;
  int measurements;
  int clusters, wires;
  int iterations;
};

// One measurement against the track fitted without it.
struct Residual {
  double residual;   // mm, measured - predicted
  double error;      // mm, of that difference
  std::int8_t side;  // wires: the side of the larger weight; clusters: 0
};

// Work space of a thread.
struct FitSpace {
  Reference reference;
  std::vector<Filtered> memory;
  std::vector<double> value, variance,
      weight;                       // per hit: signed measurement, variance, right minus left probability
  std::vector<Residual> residuals;  // of the last track, one per hit; error 0: not used
};

// Fits one track. `sides` per hit: +1 or -1 known, 0 to be found out. With `start` empty the hits provide it.
FitResult fit_track(const Detector& detector, std::span<const Hit> hits, std::span<const std::int8_t> sides,
                    double mass, const Perigee* start, const FitSettings& settings, FitSpace& space);

}  // namespace cgemit

// Track fit: Kalman filter from the outermost hit inward to the origin, linearised about a reference that is
// renewed until it stops moving.
#pragma once

#include <array>
#include <cstdint>
#include <span>

#include "common/status.hpp"
#include "kalman/group.hpp"

namespace cgemit {

// Values live in `cgemit.fit.FitSettings`.
struct FitSettings {
  int max_iterations;
  // The reference has stopped when every parameter moves by less, in its standard deviation.
  double tolerance;
  bool errors_from_track;  // cluster errors from size and the track's incidence, else from the cluster's own
                           // table
  double least_width;      // smallest spread of a cluster's position, in pitches
  double delta_strips;     // probability that a delta electron adds one strip to a cluster; 0: none does
  bool kinks;              // whether the reference of a slow track is scattered as its hits show
  double outlier_pull;  // a hit this many standard deviations from the rest of the track is left out; 0: none
  std::array<double, 5> prior_sigma;  // of d, psi, kappa, z0, tanl: weak, for the filter to begin with
};

// Tracks to fit, one after the other. Hits of a track are ordered outward; `side` per hit: +1 or -1 known, 0
// to be found out. With `start` empty the hits provide it.
struct FitInput {
  std::span<const std::int64_t>
      offsets;  // of n tracks: n + 1 places in the hits, counted from the first one's
  std::span<const Hit> hits;
  std::span<const std::int8_t> side;
  std::span<const double> mass;    // GeV
  std::span<const Perigee> start;  // one per track, or empty

  std::size_t tracks() const { return offsets.size() - 1; }
  std::size_t first(std::size_t track) const { return static_cast<std::size_t>(offsets[track] - offsets[0]); }
  std::size_t count(std::size_t track) const { return first(track + 1) - first(track); }
};

// One row per track; (dr, phi0, kappa, dz, tanl) as in the BES3 files.
struct FitRow {
  std::array<double, 5> helix;
  std::array<double, 25> covariance;
  double chi2;
  std::int32_t clusters, wires, iterations, outliers;
  FitStatus status;
};

// One row per hit, against the track fitted without it.
struct HitRow {
  double residual;    // mm, measured - predicted
  double error;       // mm, of that difference; 0: the track does not meet it
  std::int8_t side;   // wires: the side of the larger weight; clusters: 0
  std::uint8_t used;  // 0: an outlier, left out
};

// What the last iteration was made with, for states along the track; (d, psi, kappa, z0, tanl).
struct LastIteration {
  std::array<double, 5> reference;  // about which it was linearised
  std::array<double, 25> prior;     // the covariance with which its filter began
};
using KinkRow = std::array<double, 2>;  // rad, of one slab; see Kink
struct Measured {
  double value, variance;  // mm, mm^2; variance 0: the track does not meet it
};

// Where the rows go. `hits` may be null; `last`, `measured` and `kinks`, one per slab of the detector for
// each track, come together, or are null.
struct FitOutput {
  FitRow* rows;
  HitRow* hits;
  LastIteration* last;
  Measured* measured;
  KinkRow* kinks;
};

// The plain scalar path.
void fit_tracks(const Detector& detector, const FitInput& input, const FitSettings& settings,
                const FitOutput& output);

}  // namespace cgemit

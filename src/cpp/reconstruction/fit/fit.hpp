// Track fit: Kalman filter from the outermost hit inward to the origin, linearised about a reference
// trajectory that is updated until it converges.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <tuple>

#include "common/columns.hpp"
#include "common/interrupt.hpp"
#include "common/status.hpp"
#include "kalman/group.hpp"

namespace cgemit {

// Relative error of a momentum above which hits do not measure it, and error along z over that of the prior.
inline constexpr double most_error = 0.5;

// Default values are in `cgemit.reconstruction.fit.FitSettings`.
struct FitSettings {
  int max_iterations;
  // The reference has converged when no parameter moves by more than this, in standard deviations.
  double tolerance;
  bool errors_from_track;  // cluster errors from size and the track's incidence, else from the cluster's own
                           // table
  double least_width;      // smallest spread of a cluster's position, in pitches
  double delta_strips;     // probability that a delta electron adds one strip to a cluster; 0: never
  bool kinks;              // whether the reference of a slow track gets kinks from its hits
  double outlier_pull;     // a hit with a larger pull to the rest of the track is left out; 0: no outliers
  std::array<double, 5> prior_sigma;  // of d, psi, kappa, z0, tanl: the weak prior of the filter
  std::array<double, 2>
      beam;         // mm, of d and z0 of particles from the origin; 0: the beam spot is no measurement
  double momentum;  // GeV/c, assumed in matter where the curvature does not measure it
};

// Tracks to fit, one after the other. Hits of a track are ordered outward; `side` per hit: +1 or -1 known, 0
// unknown. If `start` is empty the start helices come from the hits.
struct FitInput {
  std::span<const std::int64_t>
      offsets;  // for n tracks: n + 1 indices into the hits, relative to the first one
  std::span<const Hit> hits;
  std::span<const std::int8_t> side;
  std::span<const double> mass;    // GeV
  std::span<const double> charge;  // e, unsigned
  std::span<const Perigee> start;  // one per track, or empty
  Interrupted interrupted = never_interrupted;

  std::size_t tracks() const { return offsets.size() - 1; }
  std::size_t first(std::size_t track) const { return static_cast<std::size_t>(offsets[track] - offsets[0]); }
  std::size_t count(std::size_t track) const { return first(track + 1) - first(track); }
};

// One row per track; (dr, phi0, kappa, dz, tanl) as in the BES3 files.
struct FitRow {
  std::array<double, 5> helix;
  std::array<std::array<double, 5>, 5> covariance;
  double chi2;
  std::int32_t clusters, wires, iterations, outliers;
  std::int32_t ndf;
  FitStatus status;
  // Of electrons and positrons, of ln(p/p_fit): mode, limits of 68 and of 95 %; all 0: normal with the error
  // of p.
  std::array<double, 5> limits;
  double radiated,
      radius_radiated;  // probability of a loss that the hits show; mm, where it is most probable
  double matter_p;  // GeV/c at the origin, with which the track scatters and loses energy; 0: that of kappa

  static constexpr auto columns() {
    return std::tuple(
        Column("helix", &FitRow::helix), Column("cov", &FitRow::covariance), Column("chi2", &FitRow::chi2),
        Column("ndf", &FitRow::ndf), Column("n_clusters", &FitRow::clusters),
        Column("n_wires", &FitRow::wires), Column("n_outliers", &FitRow::outliers),
        Column("iterations", &FitRow::iterations), Column("status", &FitRow::status),
        Column("limits", &FitRow::limits), Column("radiated", &FitRow::radiated),
        Column("radius_radiated", &FitRow::radius_radiated), Column("matter_p", &FitRow::matter_p));
  }
};

// One row per hit, compared with the track fitted without it.
struct HitRow {
  double residual;    // mm, measured - predicted
  double error;       // mm, of that difference; 0: the track does not cross the surface
  std::int8_t side;   // wires: the side of the larger weight; clusters: 0
  std::uint8_t used;  // 0: an outlier, not used

  static constexpr auto columns() {
    return std::tuple(Column("residual", &HitRow::residual), Column("err", &HitRow::error),
                      Column("side", &HitRow::side), Column("used", &HitRow::used));
  }
};

// Bins of losses in the density of the momentum of electrons: components without a visible loss, and with one
// in each bin, with or without others.
inline constexpr int density_bins = 10, density_components = 2 * density_bins + 1;

// The density of ln(p/p_fit): a sum of normal distributions. Unused components have weight 0; if all have,
// the density is normal with the error of p.
struct DensityRow {
  std::array<double, density_components> weight, mean, sigma;

  static constexpr auto columns() {
    return std::tuple(Column("density_weight", &DensityRow::weight),
                      Column("density_mean", &DensityRow::mean), Column("density_sigma", &DensityRow::sigma));
  }
};

// State of the last iteration, for states along the track; (d, psi, kappa, z0, tanl).
struct LastIteration {
  std::array<double, 5> reference;             // the linearisation point
  std::array<std::array<double, 5>, 5> prior;  // the covariance of the filter's prior

  static constexpr auto columns() {
    return std::tuple(Column("reference", &LastIteration::reference), Column("prior", &LastIteration::prior));
  }
};
struct KinkRow {
  std::array<double, 2> angles;  // rad, of one slab; see Kink

  static constexpr auto columns() { return std::tuple(Column("kinks", &KinkRow::angles)); }
};
struct Measured {
  double value, variance;  // mm, mm^2; variance 0: the track does not cross the surface

  static constexpr auto columns() {
    return std::tuple(Column("used_value", &Measured::value), Column("used_variance", &Measured::variance));
  }
};

// The output rows. `hits` and `densities` (one per track) may be null. `last`, `measured` and `kinks` (one
// per slab of the detector for each track) are given together, or are all null.
struct FitOutput {
  FitRow* rows;
  HitRow* hits;
  LastIteration* last;
  Measured* measured;
  KinkRow* kinks;
  DensityRow* densities;
};

// The scalar code without SIMD lanes.
void fit_tracks(const Detector& detector, const FitInput& input, const FitSettings& settings,
                const FitOutput& output);

}  // namespace cgemit

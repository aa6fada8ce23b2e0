// Covariance of a track's helix without events: the fit's own reference trajectory and filter with the hits
// that the track is expected to leave, and the exact split of the variances by measurement and scatterer.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <tuple>
#include <vector>

#include "common/columns.hpp"
#include "common/interrupt.hpp"
#include "common/status.hpp"
#include "kalman/group.hpp"

namespace cgemit {

// Errors of the expected hits, and the prior of the filter.
struct HitModel {
  // Rising; the errors of layer l for them begin at l * cos_theta.size(), linear between them and constant
  // beyond.
  std::vector<double> cos_theta;
  // Errors of X and V of each CGEM layer, mm; 0 for all: strips fire where the path touches them, and the
  // error follows from the number of strips, as in the fit.
  std::vector<double> sigma_x, sigma_v;
  std::vector<double> corr_xv;       // of the errors of X and V of each CGEM layer, where these are given
  double least_width, delta_strips;  // as in the fit
  bool sides_known;                  // whether a wire hit tells its side
  std::uint64_t seed;                // of the hits that are lost
  std::array<double, 5> prior_sigma;
};

// Tracks from the origin, or from the points nearest to the beam line that `d` and `z0` (mm; empty: 0) tell.
// `charge`: unsigned, e. `samples` tracks in a row belong to one point; they share
// its entry of the budget. `phases`: for each of the samples a number from 0 to 1 for X and V of every CGEM
// layer, which determines where the strips lie under the path. `scatters`: 1 for tracks whose trajectory
// scatters, by angles that belong to the sample; 0 for tracks on the expected trajectory. `efficiencies`: for
// each track and CGEM layer the probability that its crossing has clusters; empty: they all have. `variants`:
// detectors for which the same tracks are computed again with the hits of the first detector (the same strips
// and cells), for differences.
struct CovarianceInput {
  std::span<const double> psi, kappa, tanl, mass, charge, scatters;
  std::size_t samples;
  std::span<const double> phases, efficiencies;
  std::span<const double> d, z0;
  std::span<const Detector* const> variants;
  Interrupted interrupted = never_interrupted;

  std::size_t tracks() const { return psi.size(); }
};

// Entries of a term of the budget: variances of (d, psi, kappa, z0, tanl), and the covariance of kappa and
// tanl.
inline constexpr std::size_t budget_entries = 6;
using BudgetTerm = std::array<double, budget_entries>;

// Terms of the budget: X and V of every CGEM layer, every layer of wires, scattering and straggling of every
// slab, the filter's prior.
struct BudgetTerms {
  std::size_t layers, wires, slabs;

  explicit BudgetTerms(const Detector& detector)
      : layers(detector.layers.size()), wires(detector.wires.size()), slabs(detector.slabs.size()) {}
  std::size_t cluster(std::size_t layer, View view) const { return 2 * layer + (view == View::v ? 1 : 0); }
  std::size_t wire(std::size_t layer) const { return 2 * layers + layer; }
  std::size_t scattering(std::size_t slab) const { return 2 * layers + wires + 2 * slab; }
  std::size_t straggling(std::size_t slab) const { return scattering(slab) + 1; }
  std::size_t prior() const { return 2 * layers + wires + 2 * slabs; }
  std::size_t size() const { return prior() + 1; }
};

inline constexpr std::size_t covariance_entries = 15;  // upper triangle, row by row

struct CovarianceRow {
  std::array<double, covariance_entries> covariance;  // of (d, psi, kappa, z0, tanl)
  std::int32_t clusters, wires;
  FitStatus status;

  static constexpr auto columns() {
    return std::tuple(Column("covariance", &CovarianceRow::covariance),
                      Column("n_clusters", &CovarianceRow::clusters),
                      Column("n_wires", &CovarianceRow::wires), Column("status", &CovarianceRow::status));
  }
};

// A hit that a track is expected to leave, on its reference trajectory.
struct ExpectedHit {
  View view;
  std::int32_t layer;    // CGEM layer, or number of the wire layer
  std::int32_t channel;  // sheet or wire
  double value;          // mm, X, V - k x or signed distance from the wire
  double variance;       // mm^2
  double k, x;           // x in mm

  static constexpr auto columns() {
    return std::tuple(Column("kind", &ExpectedHit::view), Column("layer", &ExpectedHit::layer),
                      Column("channel", &ExpectedHit::channel), Column("value", &ExpectedHit::value),
                      Column("variance", &ExpectedHit::variance), Column("k", &ExpectedHit::k),
                      Column("x", &ExpectedHit::x));
  }
};

// One row per track, then one per track for each variant. `budget` may be null; otherwise it holds
// `BudgetTerms` for each point: sums over its tracks with status ok, of the last variant. `hits` may be null;
// otherwise it receives the hits of the tracks, each track's from the beam line outward, without variants.
struct CovarianceOutput {
  CovarianceRow* rows;
  BudgetTerm* budget;
  Columns<ExpectedHit>* hits;
};

// Whether the surfaces of two detectors have the same order, so that hits of one can be used for the other.
bool same_surfaces(const Detector& a, const Detector& b);

// The scalar code without SIMD lanes.
void covariances(const Detector& detector, const CovarianceInput& input, const HitModel& model,
                 const CovarianceOutput& output);

}  // namespace cgemit

// Read-out without strips: positions at mid-gap smeared with given errors. Everything downstream has an exact
// answer with it.
#pragma once

#include <cstdint>

#include "detector/cluster_rows.hpp"
#include "digitize/truths.hpp"

namespace cgemit {

struct GaussianReadout {
  double sigma_x;            // mm, of X = r_readout dphi
  double sigma_v;            // mm
  double charge_per_energy;  // fC/keV, of both views together
  std::uint64_t seed;
};

// An X, a V and an XV cluster for each truth on the active area of a sheet, ordered by event, layer, sheet,
// view. X and V errors are independent. Clusters of different truths are neither merged nor combined.
ClusterColumns smear_positions(const Detector& detector, const TruthColumns& truths,
                               const GaussianReadout& readout);

}  // namespace cgemit

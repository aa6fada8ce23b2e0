// Clusters of a readout without strips. Its digis are positions.
#pragma once

#include <span>

#include "readout/cluster_rows.hpp"
#include "readout/position_errors.hpp"
#include "reconstruction/cluster/digis.hpp"

namespace cgemit {

// Every position becomes a cluster of its view, with the error of its layer in that view, mm. Where a layer
// has two views, the n-th X and the n-th V position of a sheet form an XV cluster. Rows ordered by event,
// layer, sheet, then X, V and XV clusters. Throws std::invalid_argument if a sheet of two views does not have
// as many X as V positions.
Columns<ClusterRow> clusters_of_positions(const Detector& detector, const DigiView& digis,
                                          std::span<const PositionErrors> errors);

}  // namespace cgemit

// Clusters of a read-out without strips. Its digis are positions.
#pragma once

#include "detector/cluster_rows.hpp"
#include "reconstruction/cluster/digis.hpp"

namespace cgemit {

// Every position becomes a cluster of its view, with the error of that view in mm. The n-th X and the n-th V
// position of a sheet form an XV cluster. Rows ordered by event, layer, sheet, then X, V and XV clusters.
// Throws std::invalid_argument if a sheet does not have as many X as V positions.
ClusterColumns clusters_of_positions(const Detector& detector, const DigiView& digis, double err_x,
                                     double err_v);

}  // namespace cgemit

// Clusters of a read-out without strips, whose digis are positions.
#pragma once

#include "cluster/digis.hpp"
#include "detector/cluster_rows.hpp"

namespace cgemit {

// Every position is a cluster of its view, with the error of that view in mm; the n-th X and the n-th V
// position of a sheet belong together and make an XV cluster. Rows ordered by event, layer, sheet, then X, V
// and XV clusters. Throws std::invalid_argument where a sheet has not as many X as V positions.
ClusterColumns clusters_of_positions(const Detector& detector, const DigiView& digis, double err_x,
                                     double err_v);

}  // namespace cgemit

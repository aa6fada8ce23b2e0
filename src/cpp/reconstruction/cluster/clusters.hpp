// Makes clusters of fired strips: contiguous strips of one view, and pairs of views that intersect.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>

#include "readout/cluster_rows.hpp"
#include "readout/strip_maps.hpp"
#include "reconstruction/cluster/digis.hpp"

namespace cgemit {

// Position errors by layer and cluster size: row = layer, column = size - 1; the last column is for all
// larger sizes.
struct ErrorTable {
  std::span<const double> x, v;  // mm
  std::size_t sizes;

  double of(std::span<const double> values, std::int32_t layer, std::int32_t size) const {
    const std::size_t at = std::min(static_cast<std::size_t>(size), sizes) - 1;
    return values[static_cast<std::size_t>(layer) * sizes + at];
  }
};

// Position of a cluster: geometric centre of its strips, or charge-weighted mean of their centres.
enum class Position { centre, charge };

// Rows ordered by event, layer, sheet, then X, V and XV clusters. Within an event the digis may come in any
// order. Strips of the mask count as not there.
Columns<ClusterRow> find_clusters(const Detector& detector, const DigiView& digis, const ErrorTable& errors,
                                  Position position, const StripMask& mask);

}  // namespace cgemit

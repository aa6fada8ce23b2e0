// Position errors of clusters by number of strips, averaged over a sample of tracks.
#pragma once

#include <span>
#include <vector>

namespace cgemit {

// RMS of the position error, mm, of clusters of 1, 2, ..., `sizes` strips made by paths of these extents, mm.
// All extents are equally probable; if there are none, paths have extent 0. Sizes made by less than one path
// in a thousand, and the last entry, are attributed to clusters with strips added by other causes: the path
// lies anywhere in them. Throws std::invalid_argument for numbers that are not lengths.
std::vector<double> size_errors(std::span<const double> extents, double pitch, std::size_t sizes);

}  // namespace cgemit

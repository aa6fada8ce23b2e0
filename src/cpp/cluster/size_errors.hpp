// Position errors of clusters by number of strips, averaged over a sample of tracks.
#pragma once

#include <span>
#include <vector>

namespace cgemit {

// RMS of the position error, mm, of clusters of 1, 2, ..., `sizes` strips made by paths of these extents, mm,
// which are equally probable; without any, by paths of extent 0. Sizes that less than one path in a thousand
// makes, and the last entry, are those of clusters to which something else added strips: the path lies
// anywhere in them. Throws std::invalid_argument for numbers that are no lengths.
std::vector<double> size_errors(std::span<const double> extents, double pitch, std::size_t sizes);

}  // namespace cgemit

#include "reconstruction/cluster/size_errors.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "readout/cluster_errors.hpp"

namespace cgemit {
namespace {

constexpr double rare = 1e-3;  // sizes made by a smaller share of the paths have another cause

// Sums over paths, for one number of strips.
struct Sums {
  double length = 0;    // mm, of the intervals of paths that touch this number: probability times the pitch
  double cubed = 0;     // mm^3
  double anywhere = 0;  // mm^2

  void add(double interval) {
    length += interval;
    cubed += interval * interval * interval;
  }
};

}  // namespace

std::vector<double> size_errors(std::span<const double> extents, double pitch, std::size_t sizes) {
  static constexpr double point[] = {0.0};
  if (extents.empty()) extents = point;
  const bool lengths = std::ranges::all_of(extents, [](double w) { return w >= 0 && std::isfinite(w); });
  if (!lengths || !(pitch > 0) || sizes == 0) {
    throw std::invalid_argument("size_errors: expected extents of 0 or more, a positive pitch and a size");
  }
  std::vector<Sums> sums(sizes);
  for (const double extent : extents) {
    const auto [whole, part] = touched(extent, pitch);
    if (whole < static_cast<double>(sizes)) sums[static_cast<std::size_t>(whole)].add((1 - part) * pitch);
    if (whole + 1 < static_cast<double>(sizes)) sums[static_cast<std::size_t>(whole) + 1].add(part * pitch);
    for (std::size_t i = 0; i < sizes; ++i) {
      const double length = anywhere(static_cast<double>(i + 1), extent, pitch);
      sums[i].anywhere += length * length;
    }
  }
  const auto n = static_cast<double>(extents.size());
  std::vector<double> errors;
  for (std::size_t i = 0; i < sizes; ++i) {
    const bool made = i + 1 < sizes && sums[i].length > rare * pitch * n;
    errors.push_back(std::sqrt((made ? sums[i].cubed / sums[i].length : sums[i].anywhere / n) / 12));
  }
  return errors;
}

}  // namespace cgemit

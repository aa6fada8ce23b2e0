// What the description says of single strips and of regions of a sheet: strips that give no usable signal,
// and the gain relative to that of the readout.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "detector/strip_plane.hpp"

namespace cgemit {

inline int strips_of(const MeasuringLayer& layer) { return layer.sheets * (layer.strips_x + layer.strips_v); }
inline int strips_of(const Detector& detector) {
  return detector.layers.empty() ? 0 : detector.layers.back().gid_first + strips_of(detector.layers.back());
}
inline int gid_of(const MeasuringLayer& layer, int sheet, int view, int strip) {
  return layer.gid_first + sheet * (layer.strips_x + layer.strips_v) + (view == 0 ? 0 : layer.strips_x) +
         strip;
}

// Dead and hot strips, by their running number. Clusters may bridge up to `bridge` of them in a row.
class StripMask {
 public:
  StripMask() = default;
  StripMask(const Detector& detector, std::span<const std::int32_t> gids, std::int32_t bridge)
      : bridge_(bridge) {
    const int strips = strips_of(detector);
    if (!gids.empty()) masked_.assign(static_cast<std::size_t>(strips), 0);
    for (const std::int32_t gid : gids) {
      if (gid < 0 || gid >= strips) throw std::invalid_argument("masked: strip " + std::to_string(gid));
      masked_[static_cast<std::size_t>(gid)] = 1;
    }
  }
  bool is_empty() const { return masked_.empty(); }
  bool operator()(int gid) const { return !masked_.empty() && masked_[static_cast<std::size_t>(gid)] != 0; }

  // Number of masked strips from `first` to `last`, both included.
  int count(int first, int last) const {
    int n = 0;
    for (int gid = first; gid <= last; ++gid) n += (*this)(gid);
    return n;
  }
  // Whether some strips are missing between two, apart from masked ones that a cluster may bridge, at most
  // `missing`.
  bool joins(int first, int last, std::int32_t missing) const {
    if (last <= first + 1 + missing) return true;
    if (masked_.empty() || last > first + 1 + missing + bridge_) return false;
    return last - first - 1 - std::min(count(first + 1, last - 1), bridge_) <= missing;
  }

 private:
  std::vector<std::uint8_t> masked_;  // by gid; empty: none
  std::int32_t bridge_ = 0;
};

// Relative gain by layer: each sheet has a grid of cells, rows along z from one end to the other, and columns
// along X. A layer without a grid has gain 1.
class GainMaps {
 public:
  GainMaps() = default;
  // `shape`: rows and columns of each layer's grids, 0 without; `values`: sheet by sheet, row by row.
  GainMaps(const Detector& detector, std::span<const std::int32_t> shape, std::span<const double> values) {
    if (shape.empty()) return;
    if (shape.size() != 2 * detector.layers.size()) {
      throw std::invalid_argument("gain_shape: expected rows and columns of each CGEM layer");
    }
    std::size_t first = 0;
    for (std::size_t i = 0; i < detector.layers.size(); ++i) {
      const std::int32_t rows = shape[2 * i], columns = shape[2 * i + 1];
      const auto n = static_cast<std::size_t>(detector.layers[i].sheets) * static_cast<std::size_t>(rows) *
                     static_cast<std::size_t>(columns);
      if (rows < 0 || columns < 0 || first + n > values.size()) {
        throw std::invalid_argument("gain: expected rows times columns numbers for each sheet");
      }
      grids_.push_back({rows,
                        columns,
                        {values.begin() + static_cast<std::ptrdiff_t>(first),
                         values.begin() + static_cast<std::ptrdiff_t>(first + n)}});
      first += n;
    }
  }
  // At a point of the anode; 1 off the sheets.
  double at(const Detector& detector, std::size_t layer, double phi, double z) const {
    if (grids_.empty() || grids_[layer].values.empty()) return 1;
    const MeasuringLayer& plane = detector.layers[layer];
    for (int sheet = 0; sheet < plane.sheets; ++sheet) {
      const double across = local_x(plane, sheet, phi) / plane.sheet_width();
      const double along = 0.5 * ((z - plane.ends.middle()) / plane.ends.half() + 1);
      if (across < 1) return cell(grids_[layer], sheet, across, along);
    }
    return 1;
  }

 private:
  struct Grid {
    std::int32_t rows, columns;
    std::vector<double> values;
  };
  static double cell(const Grid& grid, int sheet, double across, double along) {
    const int column = std::clamp(static_cast<int>(across * grid.columns), 0, grid.columns - 1);
    const int row = std::clamp(static_cast<int>(along * grid.rows), 0, grid.rows - 1);
    return grid.values[static_cast<std::size_t>((sheet * grid.rows + row) * grid.columns + column)];
  }
  std::vector<Grid> grids_;
};

}  // namespace cgemit

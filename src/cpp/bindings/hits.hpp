// Columns of hits as the core wants them.
#pragma once

#include <pybind11/pybind11.h>

#include <span>
#include <vector>

#include "kalman/group.hpp"

namespace cgemit::bindings {

// Columns of hits: kind u8 (0 X, 1 V, 2 wire), layer i32 (CGEM index or the experiment's wire-layer number),
// element i32 (sheet or wire), size i32, value f8 (mm), sigma f8 (mm); each of length n.
class HitColumns {
 public:
  HitColumns(const Detector& detector, const pybind11::dict& columns, pybind11::ssize_t n);

  // Hits first to first + n into `out`; needs no GIL. Throws on what the detector has not.
  void take(std::size_t first, std::size_t n, std::vector<Hit>& out) const;

 private:
  const Detector& detector_;
  pybind11::list held_;
  std::span<const std::uint8_t> kind_;
  std::span<const std::int32_t> layer_, element_, size_;
  std::span<const double> value_, sigma_;
  std::vector<int> wire_layers_;  // index by the experiment's layer number, -1: none
};

// A row of (dr, phi0, kappa, dz, tanl).
Perigee from_bes3(const double* row);

}  // namespace cgemit::bindings

// Columns of hits in the core's format.
#pragma once

#include <pybind11/pybind11.h>

#include <vector>

#include "bindings/fields.hpp"
#include "kalman/used_hit.hpp"
#include "reconstruction/fit/hit_rules.hpp"

namespace cgemit::bindings {

// Columns of n hits (`HitView`), of any number for -1. Optional: side (0, unknown), k and x (0, see Hit), row
// (for messages).
class HitColumns {
 public:
  // Throws, with `check` listing every problem with the hits too.
  HitColumns(const Detector& detector, const pybind11::dict& columns, pybind11::ssize_t n, bool check = true);

  HitProblems problems() const { return problems_of(rules_, hits_); }

  // Throws, listing the problems with the hits, or the tracks whose hits are not ordered from the beam line
  // outward.
  void check(std::span<const std::int64_t> offsets) const;

  // Copies hits first to first + n to `out`; needs no GIL.
  void take(std::size_t first, std::size_t n, std::vector<Hit>& out) const {
    copy_hits(rules_, hits_, first, n, out);
  }
  // The same for the hits of tracks. False if one of them breaks a rule or the order.
  bool take(std::span<const std::int64_t> offsets, std::vector<Hit>& out) const {
    return copy_tracks(rules_, hits_, offsets, out);
  }
  std::span<const std::int8_t> side() const { return hits_.side; }

 private:
  HitRules rules_;
  Inputs in_;
  HitView hits_;
  std::vector<std::int8_t> no_sides_;
};

// The measurements that a fit used at n hits; throws unless they are numbers.
std::vector<UsedHit> used_hits(const pybind11::dict& columns, pybind11::ssize_t n);

// Offsets of the hits of n tracks: n + 1 numbers that begin with 0 and do not decrease. Throws otherwise.
std::span<const std::int64_t> hit_offsets_of(const Array<std::int64_t>& array);

// The radii at which n tracks begin (mm), or none if all begin on the beam line.
std::span<const double> start_radii(const Array<double>& array, py::ssize_t n);

// Charges of n tracks, e; none: 1 for all.
std::vector<double> charges(const Array<double>& array, py::ssize_t n);

// A row of (dr, phi0, kappa, dz, tanl).
Perigee from_bes3(const double* row);

}  // namespace cgemit::bindings

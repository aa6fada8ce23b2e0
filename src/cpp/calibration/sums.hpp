// Normal equations of constants of the detector, from fitted tracks or from expected ones.
//
// The fit of a track is linear in its measurements: with r = measured - predicted, V their covariance
// (scattering included) and H the derivatives by the helix, W = V^-1 - V^-1 H (H' V^-1 H)^-1 H' V^-1 is the
// inverse covariance of r after the fit of the helix. With A, the derivatives of r by the constants, the sums
// over tracks are N = A' W A and b = A' W r, and the constants change the helix by B = C H' V^-1 A. The gains
// of the filter do not depend on r, so that every column of A goes through it as r does; its innovations are
// independent: N = sum e e'/S, b = sum e e_r/S.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <tuple>
#include <utility>
#include <vector>

#include "calibration/columns.hpp"
#include "common/columns.hpp"
#include "common/interrupt.hpp"
#include "kalman/used_hit.hpp"

namespace cgemit {

// Tracks, each about the helix where its fit was linearised. Hits of a track are ordered outward.
struct FittedTracks {
  std::span<const std::int64_t> offsets;  // n + 1 indices into the hits, relative to the first one
  std::span<const Hit> hits;
  std::span<const UsedHit> used;
  std::span<const Perigee> reference;
  std::span<const double> kinks;         // rad, two angles of every slab for each track
  std::span<const double> mass, charge;  // GeV; e, unsigned
  std::span<const double> matter_p;      // GeV/c, momentum in matter at the origin; 0: that of the helix
  std::array<double, 5> prior_sigma;     // of d, psi, kappa, z0, tanl
  bool scattering = true;                // false: tracks are helices, as if matter added no noise
  Interrupted interrupted = never_interrupted;

  std::size_t tracks() const { return offsets.size() - 1; }
  std::size_t first(std::size_t track) const { return static_cast<std::size_t>(offsets[track] - offsets[0]); }
  std::size_t count(std::size_t track) const { return first(track + 1) - first(track); }
};

// A track in the sums.
struct SummedTrack {
  std::uint8_t used;  // 0: its filter fails
  std::int32_t hits;
  double chi2;
  std::array<double, 5> helix;  // (dr, phi0, kappa, dz, tanl) as in the BES3 files
  std::array<std::array<double, 5>, 5> covariance;

  static constexpr auto columns() {
    return std::tuple(Column("used", &SummedTrack::used), Column("hits", &SummedTrack::hits),
                      Column("chi2", &SummedTrack::chi2), Column("helix", &SummedTrack::helix),
                      Column("cov", &SummedTrack::covariance));
  }
};

// The innovations of the measurements of tracks, with the derivatives by the constants that they still have:
// they are independent, so that N = sum e e'/S and b = sum e e_r/S over them.
struct InnovationRows {
  std::vector<std::int64_t> track;         // of each row
  std::vector<double> residual, variance;  // e_r in mm, S in mm^2
  std::vector<std::int64_t> ends;          // of the derivatives of each row
  std::vector<std::int32_t> column;        // of each derivative
  std::vector<double> derivative;          // e
};

// A symmetric matrix of many columns: dense blocks of neighbouring ones, which are there where some track
// needs them.
class BlockedMatrix {
 public:
  // `first` column of each block, and the number of columns.
  explicit BlockedMatrix(std::vector<std::int32_t> first)
      : first_(std::move(first)), block_of_(static_cast<std::size_t>(first_.back())) {
    for (std::size_t b = 0; b + 1 < first_.size(); ++b)
      for (std::int32_t c = first_[b]; c < first_[b + 1]; ++c)
        block_of_[static_cast<std::size_t>(c)] = static_cast<std::uint32_t>(b);
    blocks_.resize(count() * (count() + 1) / 2);
  }

  std::size_t count() const { return first_.size() - 1; }
  std::size_t size(std::size_t block) const {
    return static_cast<std::size_t>(first_[block + 1] - first_[block]);
  }
  // Of rows `row` and columns `column`, at most `row`. Those on the diagonal hold their lower triangle.
  std::vector<double>& block(std::size_t row, std::size_t column) {
    return blocks_[row * (row + 1) / 2 + column];
  }
  double& at(std::size_t i, std::size_t j) {
    if (i < j) std::swap(i, j);
    const std::size_t row = block_of_[i], column = block_of_[j];
    std::vector<double>& entries = block(row, column);
    if (entries.empty()) entries.resize(size(row) * size(column));
    return entries[(i - static_cast<std::size_t>(first_[row])) * size(column) + j -
                   static_cast<std::size_t>(first_[column])];
  }

 private:
  std::vector<std::int32_t> first_;
  std::vector<std::uint32_t> block_of_;
  std::vector<std::vector<double>> blocks_;
};

// The sums of single wires, as `normal`, `right` and `measured` below, and the hits of each column.
struct WireSums {
  BlockedMatrix normal;
  std::vector<double> right, measured;
  std::vector<std::int64_t> hits;

  explicit WireSums(std::vector<std::int32_t> first)
      : normal(std::move(first)), right(columns()), measured(columns()), hits(columns()) {}

 private:
  std::size_t columns() const {
    std::size_t n = 0;
    for (std::size_t b = 0; b < normal.count(); ++b) n += normal.size(b);
    return n;
  }
};

// `normal` (columns squared), `right` and `measured` (columns) are sums, to which the tracks are added;
// `measured` is the information that hits would have of a constant if helices were known. `rows`: one for
// each track. `bias` may be null; otherwise it receives the (columns, 5) derivatives of each helix.
// `wires`: of single wires, instead of all these; null without them.
// `innovations` may be null; tracks are counted from `first_track`, rows without a derivative are left out.
struct SumsOutput {
  double* normal;
  double* right;
  double* measured;
  SummedTrack* rows;
  double* bias;
  InnovationRows* innovations;
  WireSums* wires;
  std::int64_t first_track;
};

// The scalar code without SIMD lanes.
void alignment_sums(const Detector& detector, const FittedTracks& tracks, const ColumnMap& map,
                    const SumsOutput& output);

}  // namespace cgemit

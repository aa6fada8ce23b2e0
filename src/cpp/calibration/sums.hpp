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

// `normal` (columns squared), `right` and `measured` (columns) are sums, to which the tracks are added;
// `measured` is the information that hits would have of a constant if helices were known. `rows`: one for
// each track. `bias` may be null; otherwise it receives the (columns, 5) derivatives of each helix.
// `innovations` may be null; tracks are counted from `first_track`, rows without a derivative are left out.
struct SumsOutput {
  double* normal;
  double* right;
  double* measured;
  SummedTrack* rows;
  double* bias;
  InnovationRows* innovations;
  std::int64_t first_track;
};

// The scalar code without SIMD lanes.
void alignment_sums(const Detector& detector, const FittedTracks& tracks, const ColumnMap& map,
                    const SumsOutput& output);

}  // namespace cgemit

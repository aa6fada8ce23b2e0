// The reference trajectory of one track, recorded piece by piece.
#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

#include "kalman/tracer.hpp"

namespace cgemit {

using Vector5 = Eigen::Matrix<double, 5, 1>;
using Matrix5 = Eigen::Matrix<double, 5, 5>;

// All five components of a noise vector.
inline Vector5 vector5(const Five<double>& g) { return Eigen::Map<const Vector5>(g.v.data()); }
inline Vector5 vector5(const std::array<double, 4>& g) { return {g[0], g[1], g[2], g[3], 0}; }
inline Vector5 vector5(const std::array<double, 3>& g) { return {g[0], g[1], 0, g[2], 0}; }

// A measurement, or one noise vector of a scatterer.
struct TrajectoryTerm {
  Vector5 h;  // measurement row, or noise vector g (covariance g g^T)
  bool is_row;
  bool used;        // by the filter
  double value;     // measured - predicted on the reference; noise: the reference's kink in units of g
  double variance;  // of the measurement
};

// A hit, a slab, or the end of the reference.
struct Station {
  std::size_t term;  // index of its first term; the number of terms at the end
  std::int32_t hit;  // which hit, or -1
  const Slab* slab;  // or null
  HelixPoint point;  // before the slab acts
  double kappa;
  Matrix5 jacobian;  // derivatives of (d, psi, kappa, z0, tanl) with the pivot here by those at the origin
};

// Ordered from the origin outward.
struct ReferenceTrajectory {
  std::vector<TrajectoryTerm> terms;
  std::vector<Station> stations;
  std::vector<double> predicted;  // mm, one per hit: the predicted measurement
};

// Follows a helix through the matter up to the last hit. `kinks`: angles for every slab, or none. `matter_p`:
// momentum in matter at the origin, GeV/c; 0: that of the helix.
void follow(const Detector& detector, const Perigee& start, const Species& species, double matter_p,
            std::span<const Hit> hits, std::span<const double> kinks, ReferenceTrajectory& trajectory);

}  // namespace cgemit

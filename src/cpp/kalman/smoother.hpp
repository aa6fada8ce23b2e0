// The smoothed state everywhere along the track, from all measurements.
//
// Between two scatterers the state at the origin (`filter.hpp`) does not change. The filter runs inward and
// stores, before each trajectory term, the state from all outer ones. The smoothed state is then
// propagated outward from the origin through the noise (Rauch, Tung and Striebel, AIAA J. 3 (1965) 1445). The
// gain for noise Q = G G^T is A = C (C + Q)^-1 = 1 - G B^T, B = (C + Q)^-1 G, with C the filter's covariance
// outside, and the covariance is
//   C_s' = C + A (C_s - C - Q) A^T = A C_s A^T + G (1 - B^T G) G^T,
// a sum of two positive terms, whatever the rounding. (Bierman's form, which gives the residuals, is cheaper,
// but subtracts nearly equal numbers where the filter begins.)
#pragma once

#include <span>
#include <vector>

#include "kalman/trajectory.hpp"

namespace cgemit {

struct OriginState {
  Vector5 x;  // deviation from the reference
  Matrix5 c;
};

// `inward[i]`: the filtered state from trajectory terms i and beyond. The last one is the prior.
void filter_inward(const std::vector<TrajectoryTerm>& terms, const Matrix5& prior,
                   std::vector<OriginState>& inward);

// The part of a scatterer's noise that the reference already contains.
Vector5 known_noise(std::span<const TrajectoryTerm> noise);

// The smoothed state after a part of one scatterer's noise, from the state before it; a deviation from the
// reference beyond the whole scatterer. `outside`: the filtered state there.
OriginState smooth_outward(const OriginState& before, const OriginState& outside,
                           std::span<const TrajectoryTerm> noise, double part = 1.0);

}  // namespace cgemit

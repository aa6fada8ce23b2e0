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

#include <Eigen/Cholesky>
#include <cmath>
#include <span>
#include <vector>

#include "kalman/trajectory.hpp"

namespace cgemit {

struct OriginState {
  Vector5 x;  // deviation from the reference
  Matrix5 c;
};

// `inward[i]`: the filtered state from trajectory terms i and beyond. The last one is the prior.
inline void filter_inward(const std::vector<TrajectoryTerm>& terms, const Matrix5& prior,
                          std::vector<OriginState>& inward) {
  inward.resize(terms.size() + 1);
  inward.back() = {Vector5::Zero(), prior};
  for (std::size_t i = terms.size(); i-- > 0;) {
    const TrajectoryTerm& term = terms[i];
    OriginState& state = inward[i] = inward[i + 1];
    if (!term.is_row) {
      state.c.noalias() += term.h * term.h.transpose();
      state.x += term.value * term.h;
    } else if (term.used) {
      const Vector5 ch = state.c * term.h;
      const double weight = 1.0 / (term.h.dot(ch) + term.variance);
      const double innovation = term.value - term.h.dot(state.x);
      state.x += ch * (innovation * weight);
      state.c.noalias() -= (ch * weight) * ch.transpose();
    }
  }
}

// The part of a scatterer's noise that the reference already contains.
inline Vector5 known_noise(std::span<const TrajectoryTerm> noise) {
  Vector5 sum = Vector5::Zero();
  for (const TrajectoryTerm& term : noise) sum += term.value * term.h;
  return sum;
}

// The smoothed state after a part of one scatterer's noise, from the state before it; a deviation from the
// reference beyond the whole scatterer. `outside`: the filtered state there.
inline OriginState smooth_outward(const OriginState& before, const OriginState& outside,
                                  std::span<const TrajectoryTerm> noise, double part = 1.0) {
  if (noise.empty() || !(part > 0)) return before;
  using Vectors = Eigen::Matrix<double, 5, Eigen::Dynamic, 0, 5, 5>;
  Vectors g(5, static_cast<Eigen::Index>(noise.size()));
  for (std::size_t k = 0; k < noise.size(); ++k) g.col(static_cast<Eigen::Index>(k)) = noise[k].h;
  const Matrix5 c = outside.c + g * g.transpose();
  g *= std::sqrt(part);
  // Solved with unit diagonal: the parameters differ by orders of magnitude.
  const Vector5 scale = c.diagonal().cwiseSqrt().cwiseInverse();
  const Matrix5 correlation = scale.asDiagonal() * c * scale.asDiagonal();
  const Vectors b = scale.asDiagonal() * Eigen::LLT<Matrix5>(correlation).solve(scale.asDiagonal() * g);
  const Matrix5 gain = Matrix5::Identity() - g * b.transpose();
  using Square = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, 5, 5>;
  const Square left = Square::Identity(g.cols(), g.cols()) - b.transpose() * g;
  const Vector5 x = before.x - known_noise(noise);
  return {x - g * (b.transpose() * (x - outside.x)),
          gain * before.c * gain.transpose() + g * left * g.transpose()};
}

}  // namespace cgemit

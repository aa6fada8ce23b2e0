#include "kalman/smoother.hpp"

#include <Eigen/Cholesky>
#include <cmath>

namespace cgemit {

void filter_inward(const std::vector<TrajectoryTerm>& terms, const Matrix5& prior,
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

Vector5 known_noise(std::span<const TrajectoryTerm> noise) {
  Vector5 sum = Vector5::Zero();
  for (const TrajectoryTerm& term : noise) sum += term.value * term.h;
  return sum;
}

OriginState smooth_outward(const OriginState& before, const OriginState& outside,
                           std::span<const TrajectoryTerm> noise, double part) {
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

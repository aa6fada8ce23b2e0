// The Kalman filter and its smoother for a state that never moves.
//
// The state is the helix at the origin, (d, psi, kappa, z0, tanl), as a deviation x from a reference. Every
// measurement is a row h in these five coordinates and every scatterer a set of vectors g: what the track
// beyond the scatterer looks like when extrapolated to the origin. The transition matrix is 1. (Fruehwirth,
// NIM A 262 (1987) 444; smoother in the form of Bierman, Automatica 9 (1973) 503, modified Bryson-Frazier.)
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

namespace cgemit {

using Vector5 = Eigen::Matrix<double, 5, 1>;
using Matrix5 = Eigen::Matrix<double, 5, 5>;

// Something on the way: a measurement, or one direction of a scatterer's noise. Ordered from the origin
// outward.
struct Element {
  Vector5 h;  // measurement row, or noise vector g (covariance g g^T)
  bool is_row;
  std::int32_t hit;  // which measurement
  double residual;   // measured - predicted on the reference
  double variance;   // of the measurement; not positive: not used
};

// What the filter leaves behind for the smoother, and what the smoother adds; one per measurement.
struct Filtered {
  Vector5 ch;                // C h before the update
  double innovation;         // residual before the update
  double total;              // its variance
  double unbiased;           // residual to all other measurements
  double unbiased_variance;  // and its variance, the measurement's own included
};

struct Estimate {
  Vector5 x;
  Matrix5 c;
  double chi2;
};

// From the outermost element inward to the origin. `memory` is indexed like `elements`.
inline Estimate filter(const std::vector<Element>& elements, const Vector5& prior_sigma,
                       std::vector<Filtered>& memory) {
  Estimate state{Vector5::Zero(), prior_sigma.cwiseAbs2().asDiagonal(), 0.0};
  memory.resize(elements.size());
  for (std::size_t i = elements.size(); i-- > 0;) {
    const Element& element = elements[i];
    if (!element.is_row) {
      state.c.noalias() += element.h * element.h.transpose();
      continue;
    }
    if (!(element.variance > 0)) continue;
    Filtered& m = memory[i];
    m.ch.noalias() = state.c * element.h;
    m.total = element.h.dot(m.ch) + element.variance;
    m.innovation = element.residual - element.h.dot(state.x);
    const double weight = 1.0 / m.total;
    state.x += m.ch * (m.innovation * weight);
    state.c.noalias() -= (m.ch * weight) * m.ch.transpose();
    state.chi2 += m.innovation * m.innovation * weight;
  }
  return state;
}

// From the origin outward: the residual of every measurement to the track fitted without it.
inline void smooth(const std::vector<Element>& elements, std::vector<Filtered>& memory) {
  Vector5 lambda = Vector5::Zero();
  Matrix5 big_lambda = Matrix5::Zero();
  for (std::size_t i = 0; i < elements.size(); ++i) {
    const Element& element = elements[i];
    if (!element.is_row || !(element.variance > 0)) continue;
    Filtered& m = memory[i];
    const double weight = 1.0 / m.total;
    const Vector5 gain = m.ch * weight;
    const Vector5 lk = big_lambda * gain;
    const double u = m.innovation * weight + gain.dot(lambda);
    const double information = weight + gain.dot(lk);
    m.unbiased = u / information;
    m.unbiased_variance = 1.0 / information;
    lambda -= element.h * u;
    big_lambda.noalias() +=
        element.h * (information * element.h - lk).transpose() - lk * element.h.transpose();
  }
}

}  // namespace cgemit

// Inverse of the derivatives of a track's parameters at one point by those at another.
#pragma once

#include "kalman/vector.hpp"

namespace cgemit {

// Five rows by (d, psi, kappa, z0, tanl). The block of d and psi is inverted first: its determinant stays
// near 1 however far a track has turned. The remaining diagonal entries also stay near 1, so that no rows
// need to be exchanged.
template <class T>
std::array<Five<T>, parameters> inverse(std::array<Five<T>, parameters> m) {
  const T per = 1.0 / (m[0][0] * m[1][1] - m[0][1] * m[1][0]);
  const T c00 = m[1][1] * per, c01 = -m[0][1] * per, c10 = -m[1][0] * per, c11 = m[0][0] * per;
  // Gauss-Jordan elimination in the same array, with one 2x2 pivot and three single ones.
  unroll<3>([&](auto i) {
    Five<T>& row = m[i + 2];
    const T a = row[0] * c00 + row[1] * c10, b = row[0] * c01 + row[1] * c11;
    unroll<3>([&](auto j) { row[j + 2] -= a * m[0][j + 2] + b * m[1][j + 2]; });
    row[0] = -a;
    row[1] = -b;
  });
  unroll<3>([&](auto j) {
    const T a = m[0][j + 2], b = m[1][j + 2];
    m[0][j + 2] = c00 * a + c01 * b;
    m[1][j + 2] = c10 * a + c11 * b;
  });
  m[0][0] = c00;
  m[0][1] = c01;
  m[1][0] = c10;
  m[1][1] = c11;
  unroll<3>([&](auto number) {
    constexpr int k = number + 2;
    Five<T>& pivot = m[k];
    const T per_pivot = 1.0 / pivot[k];
    unroll<parameters>([&](auto j) {
      if constexpr (j != k) pivot[j] *= per_pivot;
    });
    unroll<parameters>([&](auto i) {
      if constexpr (i != k) {
        const T factor = m[i][k];
        unroll<parameters>([&](auto j) {
          if constexpr (j != k) m[i][j] -= factor * pivot[j];
        });
        m[i][k] = -factor * per_pivot;
      }
    });
    pivot[k] = per_pivot;
  });
  return m;
}

}  // namespace cgemit

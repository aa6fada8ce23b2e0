// Five-vectors and symmetric 5x5 matrices of any number type, in the order (d, psi, kappa, z0, tanl).
#pragma once

#include <array>
#include <utility>

#include "common/lanes/pack.hpp"

namespace cgemit {

inline constexpr int parameters = 5;

// f(0), f(1) ... f(n - 1) with a constant index, so that small arrays stay in registers.
template <int n, class F>
void unroll(F&& f) {
  [&f]<int... i>(std::integer_sequence<int, i...>) {
    (f(std::integral_constant<int, i>{}), ...);
  }(std::make_integer_sequence<int, n>{});
}

template <class T>
struct Five {
  std::array<T, parameters> v;

  static Five zero() { return {{T(0.0), T(0.0), T(0.0), T(0.0), T(0.0)}}; }
  T& operator[](int i) { return v[static_cast<std::size_t>(i)]; }
  const T& operator[](int i) const { return v[static_cast<std::size_t>(i)]; }
  auto begin() { return v.begin(); }
  auto end() { return v.end(); }
  auto begin() const { return v.begin(); }
  auto end() const { return v.end(); }
};

template <class T>
Five<T> operator*(T a, Five<T> b) {
  unroll<parameters>([&](auto i) { b[i] = a * b[i]; });
  return b;
}

template <class T>
Five<T> operator+(Five<T> a, const Five<T>& b) {
  unroll<parameters>([&](auto i) { a[i] += b[i]; });
  return a;
}

template <class T>
Five<T> operator-(Five<T> a, const Five<T>& b) {
  unroll<parameters>([&](auto i) { a[i] -= b[i]; });
  return a;
}

template <class T>
T dot(const Five<T>& a, const Five<T>& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4];
}

template <class T>
Five<T> select(mask_of<T> m, Five<T> a, const Five<T>& b) {
  unroll<parameters>([&](auto i) { a[i] = select(m, a[i], b[i]); });
  return a;
}

// The upper triangle.
template <class T>
struct Symmetric {
  std::array<T, parameters*(parameters + 1) / 2> v;

  static constexpr int entry(int i, int j) {
    return i <= j ? i * parameters - i * (i - 1) / 2 + j - i : entry(j, i);
  }
  static Symmetric diagonal(const Five<T>& d) {
    Symmetric s;
    for (T& x : s.v) x = 0.0;
    unroll<parameters>([&](auto i) { s(i, i) = d[i]; });
    return s;
  }
  T& operator()(int i, int j) { return v[static_cast<std::size_t>(entry(i, j))]; }
  const T& operator()(int i, int j) const { return v[static_cast<std::size_t>(entry(i, j))]; }

  Five<T> operator*(const Five<T>& h) const {
    Five<T> out;
    unroll<parameters>([&](auto i) {
      out[i] = (*this)(i, 0) * h[0] + (*this)(i, 1) * h[1] + (*this)(i, 2) * h[2] + (*this)(i, 3) * h[3] +
               (*this)(i, 4) * h[4];
    });
    return out;
  }
  // Adds f(i, j) to every entry.
  template <class F>
  void add(F&& f) {
    unroll<parameters>([&](auto i) {
      unroll<parameters>([&](auto j) {
        if constexpr (j >= i) (*this)(i, j) += f(i, j);
      });
    });
  }
};

// Whether a matrix is a valid covariance of five real parameters: the pivots of its Cholesky decomposition
// are positive by more than the rounding error of a variance.
template <class T>
mask_of<T> positive_definite(Symmetric<T> c) {
  constexpr double rounding = 1e-11;
  const Five<T> variance = {{c(0, 0), c(1, 1), c(2, 2), c(3, 3), c(4, 4)}};
  mask_of<T> good(true);
  unroll<parameters>([&](auto k) {
    const T scale = c(k, k);
    good = good & (scale > 0.0) & (scale > rounding * variance[k]);
    const T per_pivot = 1.0 / select(scale > 0.0, scale, T(1.0));
    unroll<parameters>([&](auto i) {
      unroll<parameters>([&](auto j) {
        if constexpr (i > k && j >= i) c(i, j) -= c(k, i) * c(k, j) * per_pivot;
      });
    });
  });
  return good;
}

// x with c x = b, for a positive definite matrix c (Gauss elimination, symmetric, without exchange of rows).
template <class T>
Five<T> solve(Symmetric<T> c, Five<T> b) {
  unroll<parameters>([&](auto k) {
    const T per_pivot = 1.0 / c(k, k);
    unroll<parameters>([&](auto i) {
      if constexpr (i > k) {
        const T factor = c(k, i) * per_pivot;
        b[i] -= factor * b[k];
        unroll<parameters>([&](auto j) {
          if constexpr (j >= i) c(i, j) -= factor * c(k, j);
        });
      }
    });
  });
  unroll<parameters>([&](auto number) {
    constexpr int k = parameters - 1 - number;
    unroll<parameters>([&](auto j) {
      if constexpr (j > k) b[k] -= c(k, j) * b[j];
    });
    b[k] = b[k] / c(k, k);
  });
  return b;
}

}  // namespace cgemit

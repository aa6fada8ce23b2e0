// The number types of the kernels. A kernel is written once, for a number type T: `double`, or a pack of W
// tracks side by side, one per SIMD lane. The operations needed beyond arithmetic are defined here for both:
// masks instead of `if`,
//   select(mask, a, b)     lane by lane a or b
//   choose(mask, f, g)     the same for two functions; a function that no lane needs is not called
//   any(mask), all(mask)
// and square root, absolute value, smaller, larger, lane by lane access. Functions are in
// `common/lanes/math.hpp`. The result of a lane must not depend on the other lanes, to the last bit: `choose`
// ensures this, `if (all(...))` around one of two formulas does not.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#include "common/compiler.hpp"

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace cgemit {

#if CGEMIT_VECTORS

// The compiler's vector types: W numbers, W 64-bit integers.
template <int W>
struct Registers;
#define CGEMIT_REGISTERS(W)                                              \
  template <>                                                            \
  struct Registers<W> {                                                  \
    typedef double Numbers __attribute__((vector_size(8 * (W))));        \
    typedef std::int64_t Integers __attribute__((vector_size(8 * (W)))); \
    typedef std::uint64_t Bits __attribute__((vector_size(8 * (W))));    \
  };
CGEMIT_REGISTERS(2)
CGEMIT_REGISTERS(4)
CGEMIT_REGISTERS(8)
#undef CGEMIT_REGISTERS

// A truth value per lane: all bits of it.
template <int W>
struct Mask {
  using Vector = typename Registers<W>::Integers;
  Vector v;

  Mask() = default;
  Mask(bool b) : v(Vector{} - std::int64_t{b}) {}
  explicit Mask(Vector vector) : v(vector) {}
  bool operator[](int lane) const { return v[lane] != 0; }
  void set(int lane, bool b) { v[lane] = -std::int64_t{b}; }
  friend Mask operator&(Mask a, Mask b) { return Mask(a.v & b.v); }
  friend Mask operator|(Mask a, Mask b) { return Mask(a.v | b.v); }
  friend Mask operator!(Mask a) { return Mask(~a.v); }
};

template <int W>
unsigned bits(Mask<W> m) {
#if defined(__AVX__)
  if constexpr (W == 4) return static_cast<unsigned>(_mm256_movemask_pd(reinterpret_cast<__m256d>(m.v)));
#endif
#if defined(__SSE2__)
  if constexpr (W == 2) return static_cast<unsigned>(_mm_movemask_pd(reinterpret_cast<__m128d>(m.v)));
#endif
  unsigned all = 0;
  for (int i = 0; i < W; ++i) all |= static_cast<unsigned>(m[i]) << i;
  return all;
}

#if defined(__AVX512F__)
// Mask registers.
template <>
struct Mask<8> {
  __mmask8 v;

  Mask() = default;
  Mask(bool b) : v(b ? 0xFF : 0) {}
  explicit Mask(__mmask8 m) : v(m) {}
  bool operator[](int lane) const { return ((v >> lane) & 1) != 0; }
  void set(int lane, bool b) {
    v = static_cast<__mmask8>((v & ~(1U << lane)) | (static_cast<unsigned>(b) << lane));
  }
  friend Mask operator&(Mask a, Mask b) { return Mask(static_cast<__mmask8>(a.v & b.v)); }
  friend Mask operator|(Mask a, Mask b) { return Mask(static_cast<__mmask8>(a.v | b.v)); }
  friend Mask operator!(Mask a) { return Mask(static_cast<__mmask8>(~a.v)); }
};
inline unsigned bits(Mask<8> m) { return m.v; }
#endif

template <int W>
bool any(Mask<W> m) {
  return bits(m) != 0;
}
template <int W>
bool all(Mask<W> m) {
  return bits(m) == (1U << W) - 1;
}

template <int W>
struct Pack {
  using Vector = typename Registers<W>::Numbers;
  Vector v;

  Pack() = default;
  Pack(double x) : v(Vector{} + x) {}
  explicit Pack(Vector vector) : v(vector) {}
  double operator[](int lane) const { return v[lane]; }
  void set(int lane, double x) { v[lane] = x; }

  friend Pack operator+(Pack a, Pack b) { return Pack(a.v + b.v); }
  friend Pack operator-(Pack a, Pack b) { return Pack(a.v - b.v); }
  friend Pack operator*(Pack a, Pack b) { return Pack(a.v * b.v); }
  friend Pack operator/(Pack a, Pack b) { return Pack(a.v / b.v); }
  friend Pack operator-(Pack a) { return Pack(-a.v); }
  Pack& operator+=(Pack b) { return *this = *this + b; }
  Pack& operator-=(Pack b) { return *this = *this - b; }
  Pack& operator*=(Pack b) { return *this = *this * b; }

#if defined(__AVX512F__)
#define CGEMIT_COMPARE(op, predicate)                          \
  friend Mask<W> operator op(Pack a, Pack b) {                 \
    if constexpr (W == 8)                                      \
      return Mask<W>(_mm512_cmp_pd_mask(a.v, b.v, predicate)); \
    else                                                       \
      return Mask<W>(typename Mask<W>::Vector(a.v op b.v));    \
  }
#else
#define CGEMIT_COMPARE(op, predicate) \
  friend Mask<W> operator op(Pack a, Pack b) { return Mask<W>(typename Mask<W>::Vector(a.v op b.v)); }
#endif
  CGEMIT_COMPARE(<, _CMP_LT_OQ)
  CGEMIT_COMPARE(<=, _CMP_LE_OQ)
  CGEMIT_COMPARE(>, _CMP_GT_OQ)
  CGEMIT_COMPARE(>=, _CMP_GE_OQ)
  CGEMIT_COMPARE(==, _CMP_EQ_OQ)
  CGEMIT_COMPARE(!=, _CMP_NEQ_UQ)
#undef CGEMIT_COMPARE
};

template <int W>
Pack<W> select(Mask<W> m, Pack<W> a, Pack<W> b) {
#if defined(__AVX512F__)
  if constexpr (W == 8)
    return Pack<W>(typename Pack<W>::Vector(_mm512_mask_blend_pd(m.v, b.v, a.v)));
  else
#endif
    return Pack<W>(m.v ? a.v : b.v);
}
template <int W>
Pack<W> select(Mask<W> m, Pack<W> a, double b) {
  return select(m, a, Pack<W>(b));
}
template <int W>
Pack<W> select(Mask<W> m, double a, Pack<W> b) {
  return select(m, Pack<W>(a), b);
}

template <int W>
Pack<W> sqrt(Pack<W> x) {
#if defined(__AVX512F__)
  if constexpr (W == 8) return Pack<W>(typename Pack<W>::Vector(_mm512_sqrt_pd(x.v)));
#endif
#if defined(__AVX__)
  if constexpr (W == 4) return Pack<W>(typename Pack<W>::Vector(_mm256_sqrt_pd(x.v)));
#endif
#if defined(__SSE2__)
  if constexpr (W == 2) return Pack<W>(typename Pack<W>::Vector(_mm_sqrt_pd(x.v)));
#endif
  for (int i = 0; i < W; ++i) x.v[i] = std::sqrt(x.v[i]);
  return x;
}

template <int W>
Pack<W> abs(Pack<W> x) {
  using Bits = typename Registers<W>::Integers;
  return Pack<W>(reinterpret_cast<typename Pack<W>::Vector>(reinterpret_cast<Bits>(x.v) & INT64_MAX));
}

// |x| with the sign of y.
template <int W>
Pack<W> copysign(Pack<W> x, Pack<W> y) {
  using Bits = typename Registers<W>::Integers;
  return Pack<W>(reinterpret_cast<typename Pack<W>::Vector>((reinterpret_cast<Bits>(x.v) & INT64_MAX) |
                                                            (reinterpret_cast<Bits>(y.v) & INT64_MIN)));
}

template <int W, class F, class G>
Pack<W> choose(Mask<W> m, F&& f, G&& g) {
  if (all(m)) return f();
  if (!any(m)) return g();
  return select(m, f(), g());
}

// Rounds to a nearest whole number, |x| < 2^51.
template <int W>
Pack<W> nearest(Pack<W> x) {
  return (x + 0x1.8p52) - 0x1.8p52;
}

// Of all lanes.
template <int W>
double sum(Pack<W> x) {
#if defined(__AVX512F__)
  if constexpr (W == 8) return _mm512_reduce_add_pd(x.v);
#endif
  double all = 0;
  for (int i = 0; i < W; ++i) all += x.v[i];
  return all;
}

template <int W>
double lane(const Pack<W>& x, int i) {
  return x.v[i];
}
template <int W>
void set_lane(Pack<W>& x, int i, double value) {
  x.v[i] = value;
}
template <int W>
bool lane(const Mask<W>& m, int i) {
  return m[i];
}
template <int W>
void set_lane(Mask<W>& m, int i, bool value) {
  m.set(i, value);
}

#endif

// The same for one track.
using std::abs;
using std::copysign;
using std::sqrt;
inline bool any(bool m) { return m; }
inline bool all(bool m) { return m; }
inline double select(bool m, double a, double b) { return m ? a : b; }
template <class F, class G>
double choose(bool m, F&& f, G&& g) {
  return m ? f() : g();
}
inline double sum(double x) { return x; }
inline double nearest(double x) { return (x + 0x1.8p52) - 0x1.8p52; }
inline double lane(const double& x, int) { return x; }
inline void set_lane(double& x, int, double value) { x = value; }
inline bool lane(const bool& m, int) { return m; }
inline void set_lane(bool& m, int, bool value) { m = value; }

template <class T>
struct Lanes {
  static constexpr int width = 1;
  using Mask = bool;
};
#if CGEMIT_VECTORS
template <int W>
struct Lanes<Pack<W>> {
  static constexpr int width = W;
  using Mask = cgemit::Mask<W>;
};
#endif
template <class T>
using mask_of = typename Lanes<T>::Mask;
template <class T>
inline constexpr int lanes_of = Lanes<T>::width;

// Calls f with the number of each lane in the mask.
template <class M, class F>
void each_lane(const M& mask, F&& f) {
  if constexpr (std::is_integral_v<M>) {
    if (mask) f(0);
  } else {
    for (unsigned left = bits(mask); left != 0; left &= left - 1) f(std::countr_zero(left));
  }
}

// The numbers f(0), f(1), ... of the lanes.
template <class T, class F>
T gathered(F&& f) {
  if constexpr (lanes_of<T> == 1)
    return f(0);
  else
    return [&]<int... lane>(std::integer_sequence<int, lane...>) {
      return T(typename T::Vector{f(lane)...});
    }(std::make_integer_sequence<int, lanes_of<T>>());
}

// Consecutive numbers in memory.
template <class T>
T loaded(const double* from) {
  T found;
  std::memcpy(&found, from, sizeof(T));
  return found;
}
template <class T>
void store(const T& x, double* to) {
  std::memcpy(to, &x, sizeof(T));
}

template <class T>
T smaller(const T& a, const std::type_identity_t<T>& b) {
  return select(b < a, b, a);
}
template <class T>
T larger(const T& a, const std::type_identity_t<T>& b) {
  return select(a < b, b, a);
}

}  // namespace cgemit

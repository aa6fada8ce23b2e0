// Functions of a pack of numbers: logarithm, exponential, sine and cosine, arctangent. They use polynomials
// and rational functions of the Cephes library (S. L. Moshier, Methods and Programs for Mathematical
// Functions, 1989), for normal numbers in the ranges given, and agree within 2 units of the last place with
// the standard library, which is used for single numbers.
#pragma once

#include <cmath>

#include "common/lanes/pack.hpp"
#include "common/units.hpp"

namespace cgemit {

using std::atan;
using std::exp;
using std::log;

// sin(x), cos(x).
template <class T>
struct SineCosine {
  T sine, cosine;
};
inline SineCosine<double> sine_cosine(double x) { return {std::sin(x), std::cos(x)}; }

// |x| < 0.8.
template <class T>
SineCosine<T> sine_cosine_near_0(T x) {
  const T z = x * x;
  return {x + x * z *
                  (((((1.58962301576546568060e-10 * z - 2.50507477628578072866e-8) * z +
                      2.75573136213857245213e-6) *
                         z -
                     1.98412698295895385996e-4) *
                        z +
                    8.33333333332211858878e-3) *
                       z -
                   1.66666666666666307295e-1),
          1.0 - 0.5 * z +
              z * z *
                  (((((-1.13585365213876817300e-11 * z + 2.08757008419747316778e-9) * z -
                      2.75573141792967388112e-7) *
                         z +
                     2.48015872888517045348e-5) *
                        z -
                    1.38888888888730564116e-3) *
                       z +
                   4.16666666666665929218e-2)};
}

// sin(2 pi u), cos(2 pi u) for 0 <= u <= 1. The library's functions also save the rounding mode.
inline SineCosine<double> sine_cosine_of_turn(double u) {
  const int quarter = static_cast<int>(4 * u + 0.5);
  const auto [s, c] = sine_cosine_near_0(2 * pi * (u - 0.25 * quarter));
  const bool odd = quarter % 2 != 0;
  const double sine = odd ? c : s, cosine = odd ? s : c;
  return {quarter & 2 ? -sine : sine, (quarter + 1) & 2 ? -cosine : cosine};
}

#if CGEMIT_VECTORS

// x > 0.
template <int W>
Pack<W> log(Pack<W> x) {
  using Bits = typename Registers<W>::Bits;
  using Vector = typename Pack<W>::Vector;
  // x = m 2^e with sqrt(1/2) <= m < sqrt(2).
  const auto word = reinterpret_cast<Bits>(x.v);
  constexpr std::uint64_t root_half = 0x3FE6A09E667F3BCD, bias = 1023;
  const Bits offset = word - root_half;
  // The exponent as a number: small whole numbers are the low bits of 2^52 + 2^51 + n.
  const Bits exponent = ((offset + (bias << 52)) >> 52) + (0x4338000000000000 - bias);
  const Pack<W> e = Pack<W>(reinterpret_cast<Vector>(exponent)) - 0x1.8p52;
  const Pack<W> m(reinterpret_cast<Vector>(word - (offset & 0xFFF0000000000000)));
  const Pack<W> f = m - 1.0, z = f * f;
  const Pack<W> p =
      ((((1.01875663804580931796e-4 * f + 4.97494994976747001425e-1) * f + 4.70579119878881725854e0) * f +
        1.44989225341610930846e1) *
           f +
       1.79368678507819816313e1) *
          f +
      7.70838733755885391666e0;
  const Pack<W> q =
      ((((f + 1.12873587189167450590e1) * f + 4.52279145837532221105e1) * f + 8.29875266912776603211e1) * f +
       7.11544750618563894466e1) *
          f +
      2.31251620126765340583e1;
  const Pack<W> y = f * (z * p / q) - e * 2.121944400546905827679e-4 - 0.5 * z;
  return f + y + e * 0.693359375;
}

// |x| < 700.
template <int W>
Pack<W> exp(Pack<W> x) {
  using Bits = typename Registers<W>::Bits;
  using Vector = typename Pack<W>::Vector;
  const Pack<W> n = nearest(x * 1.4426950408889634073599);
  const Pack<W> r = (x - n * 6.93145751953125e-1) - n * 1.42860682030941723212e-6;
  const Pack<W> z = r * r;
  const Pack<W> p =
      r * ((1.26177193074810590878e-4 * z + 3.02994407707441961300e-2) * z + 9.99999999999999999910e-1);
  const Pack<W> q =
      ((3.00198505138664455042e-6 * z + 2.52448340349684104192e-3) * z + 2.27265548208155028766e-1) * z +
      2.00000000000000000009e0;
  const Pack<W> value = 1.0 + 2.0 * p / (q - p);
  const Bits whole = reinterpret_cast<Bits>((n + 0x1.8p52).v);
  return Pack<W>(reinterpret_cast<Vector>(reinterpret_cast<Bits>(value.v) + (whole << 52)));
}

// |x| < 1e5.
template <int W>
SineCosine<Pack<W>> sine_cosine(Pack<W> x) {
  using Bits = typename Registers<W>::Bits;
  using Vector = typename Pack<W>::Vector;
  // Subtracts quarter turns, with pi/2 in three parts.
  const Pack<W> n = nearest(x * 0.63661977236758134308);
  const auto [s, c] = sine_cosine_near_0(((x - n * 1.57079625129699707031) - n * 7.54978941586159635335e-8) -
                                         n * 5.39030285815811905290e-15);
  const Bits quarter = reinterpret_cast<Bits>((n + 0x1.8p52).v);
  const typename Registers<W>::Integers odd = (quarter & 1) != 0;
  const Bits sine_sign = (quarter & 2) << 62, cosine_sign = ((quarter + 1) & 2) << 62;
  const Vector sine = odd ? c.v : s.v, cosine = odd ? s.v : c.v;
  return {Pack<W>(reinterpret_cast<Vector>(reinterpret_cast<Bits>(sine) ^ sine_sign)),
          Pack<W>(reinterpret_cast<Vector>(reinterpret_cast<Bits>(cosine) ^ cosine_sign))};
}

template <int W>
Pack<W> atan(Pack<W> x) {
  const Pack<W> a = abs(x);
  const Mask<W> big = a > 2.41421356237309504880, middle = (a > 0.66) & !big;
  const Pack<W> t = select(big, -1.0 / a, select(middle, (a - 1.0) / (a + 1.0), a));
  const Pack<W> base =
      select(big, Pack<W>(1.5707963267948966192), select(middle, Pack<W>(0.7853981633974483096), 0.0));
  const Pack<W> rest =
      select(big, Pack<W>(6.123233995736765886e-17), select(middle, Pack<W>(3.061616997868383e-17), 0.0));
  const Pack<W> z = t * t;
  const Pack<W> p =
      (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z -
       1.228866684490136173410e2) *
          z -
      6.485021904942025371773e1;
  const Pack<W> q =
      ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2) *
           z +
       4.853903996359136964868e2) *
          z +
      1.945506571482613964425e2;
  return copysign(base + (t + (t * z * (p / q) + rest)), x);
}

// Azimuth of (x, y), in [-pi, pi]; not both 0.
template <int W>
Pack<W> atan2(Pack<W> y, Pack<W> x) {
  const Mask<W> steep = abs(y) > abs(x);
  const Pack<W> turned = copysign(Pack<W>(1.5707963267948966192), y) - atan(x / y);
  const Pack<W> flat =
      atan(y / x) + select(x < 0.0, copysign(Pack<W>(3.14159265358979323846), y), Pack<W>(0.0));
  return select(steep, turned, flat);
}

#endif

using std::atan2;

// The series are summed by twos (Estrin), since the next step waits for the result.

// atan(t)/t, exact also for t = 0.
template <class T>
T atan_over(T t) {
  const T q = t * t, q2 = q * q;
  const auto brief = [&q, &q2] {
    return (1.0 - q * (1.0 / 3)) + q2 * ((1.0 / 5 - q * (1.0 / 7)) + q2 * (1.0 / 9 - q * (1.0 / 11)));
  };
  const auto series = [&q] {
    const T tail = -1.0 / 11 + q * (1.0 / 13 + q * (-1.0 / 15 + q * (1.0 / 17 - q * (1.0 / 19))));
    return 1.0 + q * (-1.0 / 3 + q * (1.0 / 5 + q * (-1.0 / 7 + q * (1.0 / 9 + q * tail))));
  };
  return choose(q < 1e-3, brief, [&] { return choose(q < 0.02, series, [&t] { return atan(t) / t; }); });
}

// sin(f)/f and cos(f), exact to rounding also for f = 0.
template <class T>
struct SineOver {
  T sine_over, cosine;

  explicit SineOver(T f) {
    const T q = f * f, q2 = q * q;
    const mask_of<T> small = q < 1e-3;
    sine_over = (1.0 - q * (1.0 / 6)) + q2 * (1.0 / 120 - q * (1.0 / 5040));
    cosine = (1.0 - q * 0.5) + q2 * (1.0 / 24 - q * (1.0 / 720));
    if (all(small)) return;
    const SineCosine<T> whole = sine_cosine(f);
    sine_over = select(small, sine_over, whole.sine / f);
    cosine = select(small, cosine, whole.cosine);
  }
};

// tan(f)/f, exact to rounding; by its series for small f.
template <class T>
T tangent_over(T f) {
  const T q = f * f;
  const auto whole = [&f] {
    const SineCosine<T> s = sine_cosine(f);
    return s.sine / (s.cosine * f);
  };
  return choose(q > 1e-3, whole,
                [&q] { return 1.0 + q * (1.0 / 3 + q * (2.0 / 15 + q * (17.0 / 315 + q * (62.0 / 2835)))); });
}

template <class T>
T hyperbolic_tangent(T x) {
  const T a = smaller(abs(x), 20.0);  // 1 to rounding beyond
  return copysign(1.0 - 2.0 / (1.0 + exp(2.0 * a)), x);
}

}  // namespace cgemit

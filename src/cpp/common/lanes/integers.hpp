// Integers in lanes.
#pragma once

#include "common/lanes/pack.hpp"

namespace cgemit {

// The pack that fills the widest registers the compiler may use.
#if !CGEMIT_VECTORS
using Widest = double;
#elif defined(__AVX512F__)
using Widest = Pack<8>;
#elif defined(__AVX2__)
using Widest = Pack<4>;
#else
using Widest = Pack<2>;
#endif

inline std::int64_t whole(double x) { return static_cast<std::int64_t>(x); }

#if CGEMIT_VECTORS

// Converts a whole number of at most 2^51 to an integer.
template <int W>
typename Registers<W>::Integers whole(Pack<W> x) {
  return reinterpret_cast<typename Registers<W>::Integers>((x + 0x1.8p52).v) - 0x4338000000000000;
}

// Products of the low 32 bits of each integer with one number.
template <int W>
typename Registers<W>::Bits products(typename Registers<W>::Bits a, std::uint32_t b) {
#if defined(__AVX512F__)
  if constexpr (W == 8) {
    const auto all = static_cast<long long>(b);
    return
        typename Registers<W>::Bits(_mm512_mul_epu32(reinterpret_cast<__m512i>(a), _mm512_set1_epi64(all)));
  }
#endif
#if defined(__AVX2__)
  if constexpr (W == 4) {
    const auto all = static_cast<long long>(b);
    return
        typename Registers<W>::Bits(_mm256_mul_epu32(reinterpret_cast<__m256i>(a), _mm256_set1_epi64x(all)));
  }
#endif
#if defined(__SSE2__)
  if constexpr (W == 2) {
    const auto all = static_cast<long long>(b);
    return typename Registers<W>::Bits(_mm_mul_epu32(reinterpret_cast<__m128i>(a), _mm_set1_epi64x(all)));
  }
#endif
  return (a & 0xFFFFFFFFU) * b;
}

#endif

}  // namespace cgemit

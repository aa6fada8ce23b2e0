// Counters of layers side by side, one bit of a word each.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <utility>

namespace cgemit {

// 64 counters a word, up to 127 each: bit i of word j of plane k is bit k of counter 64 j + i.
template <std::size_t words>
class BitCounts {
 public:
  using Bits = std::array<std::uint64_t, words>;

  void clear() {
    planes_ = {};
    added_ = 0;
  }

  // Adds 1 to the counters whose bit is set. All words have the same steps, which compilers make in registers
  // of several words.
  void add(Bits carry) {
    const std::size_t used = std::min<std::size_t>(std::bit_width(++added_), depth);
    for (std::size_t k = 0; k < used; ++k)
      for (std::size_t j = 0; j < words; ++j) {
        const std::uint64_t both = planes_[k][j] & carry[j];
        planes_[k][j] ^= carry[j];
        carry[j] = both;
      }
  }

  std::uint8_t at(std::size_t i) const {
    unsigned count = 0;
    for (std::size_t k = 0; k < depth; ++k)
      count |= static_cast<unsigned>(planes_[k][i / 64] >> i % 64 & 1) << k;
    return static_cast<std::uint8_t>(count);
  }

  // The counters of at least `least`.
  Bits at_least(unsigned least) const {
    Bits more{}, equal;
    equal.fill(~std::uint64_t{0});
    for (std::size_t k = depth; k-- > 0;)
      for (std::size_t j = 0; j < words; ++j) {
        if ((least >> k & 1) == 0) more[j] |= equal[j] & planes_[k][j];
        equal[j] &= (least >> k & 1) == 0 ? ~planes_[k][j] : planes_[k][j];
      }
    for (std::size_t j = 0; j < words; ++j) more[j] |= equal[j];
    return more;
  }

  // The largest count, and the counters that have it.
  std::pair<int, Bits> most() const {
    int count = 0;
    Bits left;
    left.fill(~std::uint64_t{0});
    for (std::size_t k = depth; k-- > 0;) {
      Bits with;
      std::uint64_t any = 0;
      for (std::size_t j = 0; j < words; ++j) any |= with[j] = left[j] & planes_[k][j];
      if (any == 0) continue;
      left = with;
      count |= 1 << k;
    }
    return {count, left};
  }
  // The same of some counters of a word.
  std::pair<int, std::uint64_t> most(std::size_t word, std::uint64_t left) const {
    int count = 0;
    for (std::size_t k = depth; k-- > 0;) {
      const std::uint64_t with = left & planes_[k][word];
      if (with == 0) continue;
      left = with;
      count |= 1 << k;
    }
    return {count, left};
  }

 private:
  static constexpr std::size_t depth = 7;
  std::array<Bits, depth> planes_{};
  unsigned added_ = 0;
};

// Sets bits `first` to `last`. Without a branch on whether both are in one word, which nothing predicts.
template <std::size_t words>
void set_bits(std::array<std::uint64_t, words>& bits, unsigned first, unsigned last) {
  const std::uint64_t from = ~std::uint64_t{0} << first % 64, to = ~std::uint64_t{0} >> (63 - last % 64);
  const std::size_t begin = first / 64, end = last / 64;
  const std::uint64_t apart = begin == end ? 0 : ~std::uint64_t{0};
  bits[begin] |= from & (to | apart);
  bits[end] |= to & (from | apart);
  for (std::size_t j = begin + 1; j < end; ++j) bits[j] = ~std::uint64_t{0};
}

}  // namespace cgemit

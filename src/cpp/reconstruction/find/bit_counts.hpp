// Counters of layers side by side, one bit of a word each.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <utility>

namespace cgemit {

// 64 counters a word, up to 127 each: bit i of plane k of word j is bit k of counter 64 j + i.
template <std::size_t words>
class BitCounts {
 public:
  using Bits = std::array<std::uint64_t, words>;

  void clear() { planes_ = {}; }

  // Adds 1 to the counters whose bit is set.
  void add(const Bits& bits) {
    for (std::size_t j = 0; j < words; ++j) {
      std::uint64_t which = bits[j];
      for (std::size_t k = 0; which != 0 && k < depth; ++k) {
        const std::uint64_t carry = planes_[j][k] & which;
        planes_[j][k] ^= which;
        which = carry;
      }
    }
  }

  std::uint8_t at(std::size_t i) const {
    unsigned count = 0;
    for (std::size_t k = 0; k < depth; ++k)
      count |= static_cast<unsigned>(planes_[i / 64][k] >> i % 64 & 1) << k;
    return static_cast<std::uint8_t>(count);
  }

  // The counters of at least `least`.
  Bits at_least(unsigned least) const {
    Bits more{}, equal;
    equal.fill(~std::uint64_t{0});
    for (std::size_t j = 0; j < words; ++j) {
      for (std::size_t k = depth; k-- > 0;) {
        if ((least >> k & 1) == 0) more[j] |= equal[j] & planes_[j][k];
        equal[j] &= (least >> k & 1) == 0 ? ~planes_[j][k] : planes_[j][k];
      }
      more[j] |= equal[j];
    }
    return more;
  }

  // The largest count, and the counters that have it.
  std::pair<int, Bits> most() const {
    Bits all;
    all.fill(~std::uint64_t{0});
    return most(all);
  }
  // The same of some of the counters.
  std::pair<int, Bits> most(Bits left) const {
    int count = 0;
    for (std::size_t k = depth; k-- > 0;) {
      Bits with;
      std::uint64_t any = 0;
      for (std::size_t j = 0; j < words; ++j) any |= with[j] = left[j] & planes_[j][k];
      if (any == 0) continue;
      left = with;
      count |= 1 << k;
    }
    return {count, left};
  }

 private:
  static constexpr std::size_t depth = 7;
  std::array<std::array<std::uint64_t, depth>, words> planes_{};
};

// Sets bits `first` to `last`.
template <std::size_t words>
void set_bits(std::array<std::uint64_t, words>& bits, unsigned first, unsigned last) {
  const std::uint64_t from = ~std::uint64_t{0} << first % 64, to = ~std::uint64_t{0} >> (63 - last % 64);
  std::size_t j = first / 64;
  const std::size_t end = last / 64;
  if (words == 1 || j == end) {
    bits[j] |= from & to;
    return;
  }
  bits[j] |= from;
  while (++j < end) bits[j] = ~std::uint64_t{0};
  bits[end] |= to;
}

}  // namespace cgemit

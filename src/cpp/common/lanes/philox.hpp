// Random numbers of W particles side by side: each lane gets the numbers that `common/rng.hpp` gives its
// particle.
#pragma once

#include <array>
#include <cstdint>

#include "common/lanes/integers.hpp"
#include "common/lanes/math.hpp"
#include "common/rng.hpp"

namespace cgemit {

template <class T>
struct StreamTypes {
  using Stream = cgemit::Stream;
  using Block = cgemit::Block;
};
// The random numbers of a particle, or of one per lane, and four words from them.
template <class T>
using StreamOf = typename StreamTypes<T>::Stream;
template <class T>
using BlockOf = typename StreamTypes<T>::Block;

inline const Stream& lane(const Stream& stream, int) { return stream; }
inline std::uint32_t word(std::uint32_t words, int) { return words; }
inline void set_word(std::uint32_t& words, int, std::uint32_t value) { words = value; }
inline void spread(std::uint32_t& words, std::uint32_t value) { words = value; }
inline void count_along(std::uint32_t&) {}

#if CGEMIT_VECTORS

// A 32-bit word per lane, in the low half of 64 bits; the high half is undefined.
template <int W>
struct Words {
  using Vector = typename Registers<W>::Bits;
  Vector v;

  std::uint32_t operator[](int lane) const { return static_cast<std::uint32_t>(v[lane]); }
};
template <int W>
std::uint32_t word(const Words<W>& words, int lane) {
  return words[lane];
}
template <int W>
void set_word(Words<W>& words, int lane, std::uint32_t value) {
  words.v[lane] = value;
}
template <int W>
void spread(Words<W>& words, std::uint32_t value) {
  words.v = typename Words<W>::Vector{} + value;
}
// Adds 0, 1, 2, ...
template <int W>
void count_along(Words<W>& words) {
  [&words]<std::uint64_t... lane>(std::integer_sequence<std::uint64_t, lane...>) {
    words.v += typename Words<W>::Vector{lane...};
  }(std::make_integer_sequence<std::uint64_t, W>());
}

// Ten rounds of Philox4x32.
template <int W>
std::array<Words<W>, 4> philox4x32(const std::array<Words<W>, 4>& counter, std::uint32_t key0,
                                   std::uint32_t key1) {
  auto a = counter[0].v, b = counter[1].v, c = counter[2].v, d = counter[3].v;
  for (int round = 0; round < 10; ++round) {
    const auto p0 = products<W>(a, 0xD2511F53U), p1 = products<W>(c, 0xCD9E8D57U);
    a = (p1 >> 32) ^ b ^ key0;
    b = p1;
    c = (p0 >> 32) ^ d ^ key1;
    d = p0;
    key0 += 0x9E3779B9U;
    key1 += 0xBB67AE85U;
  }
  return {{{a}, {b}, {c}, {d}}};
}

template <int W>
class StreamLanes {
 public:
  explicit StreamLanes(const std::array<Stream, W>& streams) : streams_(streams) {
    for (int i = 0; i < W; ++i) {
      const auto [first, second, low, high] = lane(*this, i).counter(Purpose{}, 0, 0);
      particle_.v[i] = second;
      low_.v[i] = low;
      high_.v[i] = high;
    }
  }

  std::array<Words<W>, 4> block(Purpose purpose, std::uint32_t place, std::uint32_t block = 0) const {
    using Vector = typename Words<W>::Vector;
    const Words<W> first{Vector{} + ((static_cast<std::uint32_t>(purpose) << 26) ^ place)};
    const auto [key0, key1] = streams_[0].key();  // the same for all
    return philox4x32<W>({first, {particle_.v ^ block}, low_, high_}, key0, key1);
  }

  friend const Stream& lane(const StreamLanes& streams, int i) {
    return streams.streams_[static_cast<std::size_t>(i)];
  }

 private:
  std::array<Stream, W> streams_;
  Words<W> particle_, low_, high_;
};

template <int W>
struct StreamTypes<Pack<W>> {
  using Stream = StreamLanes<W>;
  using Block = std::array<Words<W>, 4>;
};

template <int W>
Pack<W> open_unit(Words<W> words) {
  using Vector = typename Pack<W>::Vector;
  // A small whole number is the low bits of 2^52 + n.
  const auto bits = (words.v & 0xFFFFFFFFU) | 0x4330000000000000U;
  return (Pack<W>(reinterpret_cast<Vector>(bits)) - (0x1p52 - 0.5)) * 0x1p-32;
}

template <int W>
Pack<W> normal_quantile(Pack<W> u) {
  const Pack<W> to_end = smaller(u, 1.0 - u);
  return choose(
      to_end < normal_tail_ends, [&] { return copysign(normal_tail(to_end), u - 0.5); },
      [&] { return normal_centre(u - 0.5); });
}

#endif

// Blocks of one stream in sequence, several computed at a time.
class BlocksAhead {
 public:
  BlocksAhead(const Stream& stream, Purpose purpose, std::uint32_t place, std::uint32_t first)
      : stream_(stream), purpose_(purpose), place_(place), first_(first) {}

  // Words must be requested in order, from 0.
  std::uint32_t operator[](std::uint32_t number) {
    constexpr std::uint32_t width = lanes_of<Widest>;
    if (number % (4 * width) == 0) look_ahead(number / 4);
    return word(words_[number % 4], static_cast<int>(number / 4 % width));
  }

 private:
  void look_ahead(std::uint32_t block) {
    const Block own = stream_.counter(purpose_, place_, first_ + block);
    BlockOf<Widest> counters;
    for (std::size_t k = 0; k < 4; ++k) spread(counters[k], own[k]);
    count_along(counters[1]);
    const auto [key0, key1] = stream_.key();
    words_ = philox4x32(counters, key0, key1);
  }

  const Stream& stream_;
  Purpose purpose_;
  std::uint32_t place_, first_;
  BlockOf<Widest> words_{};
};

// Blocks in sequence, of one stream or of one in each lane.
template <class T>
class BlockSeries {
 public:
  void set(int lane, const Stream& stream, Purpose purpose, std::uint32_t place, std::uint32_t first = 0) {
    key_ = stream.key();
    const Block start = stream.counter(purpose, place, first);
    for (std::size_t k = 0; k < 4; ++k) set_word(next_[k], lane, start[k]);
  }
  BlockOf<T> next() {
    const BlockOf<T> words = philox4x32(next_, key_[0], key_[1]);
    count(next_[1]);
    return words;
  }

 private:
  static void count(std::uint32_t& words) { ++words; }
#if CGEMIT_VECTORS
  template <int W>
  static void count(Words<W>& words) {
    words.v += 1;
  }
#endif
  std::array<std::uint32_t, 2> key_{};
  BlockOf<T> next_{};
};

}  // namespace cgemit

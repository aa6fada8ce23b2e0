// Counter-based random numbers: Philox4x32-10 (Salmon, Moraes, Dror, Shaw, SC'11,
// doi 10.1145/2063384.2063405). A draw is a function of (seed, event, particle, purpose, place, block) and of
// nothing else, so results do not depend on threads, chunks or on what other stages drew, and one event can
// be replayed alone.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>

#include "common/units.hpp"

namespace cgemit {

using Block = std::array<std::uint32_t, 4>;

// Ten rounds of Philox4x32.
inline Block philox4x32(Block counter, std::uint32_t key0, std::uint32_t key1) {
  for (int round = 0; round < 10; ++round) {
    const std::uint64_t p0 = std::uint64_t{0xD2511F53U} * counter[0];
    const std::uint64_t p1 = std::uint64_t{0xCD9E8D57U} * counter[2];
    counter = {static_cast<std::uint32_t>(p1 >> 32) ^ counter[1] ^ key0, static_cast<std::uint32_t>(p1),
               static_cast<std::uint32_t>(p0 >> 32) ^ counter[3] ^ key1, static_cast<std::uint32_t>(p0)};
    key0 += 0x9E3779B9U;
    key1 += 0xBB67AE85U;
  }
  return counter;
}

// What a draw is for. New purposes go to the end: the number is part of every stream.
enum class Purpose : std::uint32_t {
  gun = 0,
  scattering = 1,
  energy_loss = 2,
  digitization = 3,
  drift_distance = 4,
  fit_seed = 5,
  test = 6,
};

// Uniform in (0, 1), never 0 and never 1: 32 bits, centred.
inline double open_unit(std::uint32_t bits) { return (bits + 0.5) * 0x1p-32; }

// Two standard normal numbers from two uniform ones (Box and Muller 1958); reaches 6.7 standard deviations.
inline std::array<double, 2> normal_pair(std::uint32_t a, std::uint32_t b) {
  const double radius = std::sqrt(-2.0 * std::log(open_unit(a)));
  const double azimuth = 2.0 * pi * open_unit(b);
  return {radius * std::cos(azimuth), radius * std::sin(azimuth)};
}

// The random numbers of one particle (or one table row) of one event.
class Stream {
 public:
  Stream(std::uint64_t seed, std::uint64_t event, std::uint32_t particle)
      : key0_(static_cast<std::uint32_t>(seed)),
        key1_(static_cast<std::uint32_t>(seed >> 32)),
        event_(event),
        particle_(particle) {}

  // Four raw words for a purpose at a place (surface, layer, wire ...); `block` counts further blocks there.
  Block block(Purpose purpose, std::uint32_t place, std::uint32_t block = 0) const {
    const Block counter = {(static_cast<std::uint32_t>(purpose) << 26) ^ place, (particle_ << 12) ^ block,
                           static_cast<std::uint32_t>(event_), static_cast<std::uint32_t>(event_ >> 32)};
    return philox4x32(counter, key0_, key1_);
  }

  // Two standard normal numbers: the first (`half` 0) or second half of a block.
  std::array<double, 2> normal_pair_at(Purpose purpose, std::uint32_t place, std::size_t half) const {
    const Block words = block(purpose, place);
    return normal_pair(words[2 * half], words[2 * half + 1]);
  }

  // Four standard normal numbers.
  std::array<double, 4> normals(Purpose purpose, std::uint32_t place, std::uint32_t block_index = 0) const {
    const Block words = block(purpose, place, block_index);
    const auto first = normal_pair(words[0], words[1]);
    const auto second = normal_pair(words[2], words[3]);
    return {first[0], first[1], second[0], second[1]};
  }

 private:
  std::uint32_t key0_, key1_;
  std::uint64_t event_;
  std::uint32_t particle_;
};

}  // namespace cgemit

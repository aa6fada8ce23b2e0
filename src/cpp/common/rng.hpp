// Counter-based random numbers: Philox4x32-10 (Salmon, Moraes, Dror, Shaw, SC'11, doi
// 10.1145/2063384.2063405). A draw depends only on (seed, event, particle, purpose, place, block). Results
// therefore do not depend on threads, chunks or the draws of other stages, and one event can be replayed
// alone.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>

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

// The purpose of a draw. New purposes go to the end, because the number is part of every stream.
enum class Purpose : std::uint32_t {
  gun = 0,
  scattering = 1,
  energy_loss = 2,
  digitization = 3,
  drift_distance = 4,
  fit_seed = 5,
  test = 6,
  ionization = 7,
  deltas = 8,
  radiation = 9,
  foil = 10,
  decay = 11,
  readout_electron = 12,
  readout_truth = 13,
  readout_strip = 14,
  half_turn = 15,
  // Background (simulation/background), always of particle 0; the place is ...
  background_runs = 16,      // a wire layer, by its number
  background_cell = 17,      // a cell, by its running number
  background_clusters = 18,  // a CGEM layer
  background_noise = 19,     // a sheet and view, by its first strip
  background_strip = 20,     // a strip, by its running number
  channel_kind = 21,         // a cell (block 0) or a strip (block 1), of event 0 and seed 0
  mixed_event = 22,
  start_time = 23,
  efficiency = 24,  // of a crossing; the place is its layer
};

// Uniform in (0, 1), never 0 and never 1: 32 bits, centred.
inline double open_unit(std::uint32_t bits) { return (bits + 0.5) * 0x1p-32; }

// Standard normal number at a quantile: Acklam's rational approximation of the inverse error function (P. J.
// Acklam, 2003), relative error below 1.2e-9. It needs a logarithm in the outer 5 % only. Reaches 6.4
// standard deviations. In two parts, each for one number or several side by side: from the distance to the
// nearer end, as a positive number, and from the distance to the middle.
inline constexpr double normal_tail_ends = 0.02425;

template <class T>
T normal_tail(T u) {
  using std::log, std::sqrt;
  const T q = sqrt(-2.0 * log(u));
  return -(((((-7.784894002430293e-03 * q - 3.223964580411365e-01) * q - 2.400758277161838e+00) * q -
             2.549732539343734e+00) *
                q +
            4.374664141464968e+00) *
               q +
           2.938163982698783e+00) /
         ((((7.784695709041462e-03 * q + 3.224671290700398e-01) * q + 2.445134137142996e+00) * q +
           3.754408661907416e+00) *
              q +
          1.0);
}

template <class T>
T normal_centre(T q) {
  const T r = q * q;
  return (((((-3.969683028665376e+01 * r + 2.209460984245205e+02) * r - 2.759285104469687e+02) * r +
            1.383577518672690e+02) *
               r -
           3.066479806614716e+01) *
              r +
          2.506628277459239e+00) *
         q /
         (((((-5.447609879822406e+01 * r + 1.615858368580409e+02) * r - 1.556989798598866e+02) * r +
            6.680131188771972e+01) *
               r -
           1.328068155288572e+01) *
              r +
          1.0);
}

inline double normal_quantile(double u) {
  if (u < normal_tail_ends) return -normal_tail(u);
  if (u > 1 - normal_tail_ends) return normal_tail(1 - u);
  return normal_centre(u - 0.5);
}

// The random numbers of one particle (or one table row) of one event.
class Stream {
 public:
  Stream(std::uint64_t seed, std::uint64_t event, std::uint32_t particle)
      : key0_(static_cast<std::uint32_t>(seed)),
        key1_(static_cast<std::uint32_t>(seed >> 32)),
        event_(event),
        particle_(particle) {}

  // Four words for a purpose and a `place` (surface, layer, wire ...); `block` counts further blocks there.
  Block block(Purpose purpose, std::uint32_t place, std::uint32_t block = 0) const {
    return philox4x32(counter(purpose, place, block), key0_, key1_);
  }
  // The counter from which they are computed.
  Block counter(Purpose purpose, std::uint32_t place, std::uint32_t block) const {
    return {(static_cast<std::uint32_t>(purpose) << 26) ^ place, (particle_ << 12) ^ block,
            static_cast<std::uint32_t>(event_), static_cast<std::uint32_t>(event_ >> 32)};
  }
  std::array<std::uint32_t, 2> key() const { return {key0_, key1_}; }

  // Four standard normal numbers.
  std::array<double, 4> normals(Purpose purpose, std::uint32_t place, std::uint32_t block_index = 0) const {
    const Block words = block(purpose, place, block_index);
    return {normal_quantile(open_unit(words[0])), normal_quantile(open_unit(words[1])),
            normal_quantile(open_unit(words[2])), normal_quantile(open_unit(words[3]))};
  }

 private:
  std::uint32_t key0_, key1_;
  std::uint64_t event_;
  std::uint32_t particle_;
};

}  // namespace cgemit

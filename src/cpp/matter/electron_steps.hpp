// Physics of one electron step: the layer's values at the electron's energy, turns in the field, soft and
// hard scatters.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>

#include "common/lanes/philox.hpp"
#include "common/units.hpp"
#include "matter/electrons.hpp"

namespace cgemit {

namespace electron_step {

inline constexpr double longest_step = 1.5;     // mm in the gap, recorded as a straight piece
inline constexpr double largest_turn = 0.3;     // rad in the field in one step
inline constexpr double shortest_piece = 0.05;  // mm; shorter ones are joined
inline constexpr double farthest =
    50;  // mm in u; farther away a layer is not a plane, and other layers follow
inline constexpr std::uint32_t most_steps =
    4096;  // blocks of random numbers per stream: enough for a metre of gas

// The properties of a layer for an electron of the present energy.
template <class T>
struct Local {
  T stopping, path, cut, screening, soft, per_momentum;  // as in `ElectronPoint`
  T slope;                                               // d(stopping)/d(energy), 1/mm
};

// Bin of an energy on the grid, read from the bits of the number: the exponent and the first four bits of the
// mantissa.
inline std::size_t bin_of(double energy) {
  constexpr std::uint64_t first = std::bit_cast<std::uint64_t>(electron_grid_first) >> 48;
  return std::min<std::uint64_t>((std::bit_cast<std::uint64_t>(energy) >> 48) - first, electron_points - 2);
}
inline double part_of(double energy) {
  return static_cast<double>(std::bit_cast<std::uint64_t>(energy) & 0xFFFFFFFFFFFF) * 0x1p-48;
}
inline double power_of_two(double energy) {
  return std::bit_cast<double>(std::bit_cast<std::uint64_t>(energy) >> 52 << 52);
}
#if CGEMIT_VECTORS
template <int W>
Pack<W> part_of(Pack<W> energy) {
  const auto bits = std::bit_cast<typename Words<W>::Vector>(energy.v);
  const auto number = (bits & 0xFFFFFFFFFFFF) | 0x4330000000000000;  // 2^52 and more
  return (Pack<W>(std::bit_cast<typename Pack<W>::Vector>(number)) - 0x1p52) * 0x1p-48;
}
template <int W>
Pack<W> power_of_two(Pack<W> energy) {
  const auto bits = std::bit_cast<typename Words<W>::Vector>(energy.v);
  return Pack<W>(std::bit_cast<typename Pack<W>::Vector>(bits >> 52 << 52));
}
#endif

// Turns the direction about the field axis.
template <class T>
void turn(ElectronOf<T>& electron, const T& angle) {
  const T q = angle * angle;  // at most largest_turn^2: next terms below 1e-6
  const T cosine = 1.0 - q / 2.0 * (1.0 - q / 12.0), sine = angle * (1.0 - q / 6.0 * (1.0 - q / 20.0));
  const T dw = cosine * electron.dw - sine * electron.du;
  electron.du = cosine * electron.du + sine * electron.dw;
  electron.dw = dw;
}

template <class T>
T hard_scatter(const Local<T>& here, const T& uniform) {
  const T most = 1.0 / (here.cut + here.screening), least = 1.0 / (1.0 + here.screening);
  return 1.0 / (most - uniform * (most - least)) - here.screening;
}

// Soft scatters on a path: the mean cosines of successive scatters multiply, and mu is exponentially
// distributed about its mean.
template <class T>
T soft_scatter(const Local<T>& here, const T& way, const T& uniform) {
  const T sum = here.soft * way;
  const T mean = choose(
      sum < 0.05, [&] { return sum * (1.0 - sum); },
      [&] { return 0.5 * (1.0 - exp(-2.0 * smaller(sum, 100.0))); });
  return smaller(-mean * log(uniform), 1.0);
}

// Directions around a circle, from the first ten of sixteen bits.
struct Around {
  double cosine, sine;
};
inline const std::array<Around, 1024>& circle() {
  static const auto directions = [] {
    std::array<Around, 1024> table{};
    for (std::size_t i = 0; i < table.size(); ++i) {
      const double angle = 2 * pi * (static_cast<double>(i) + 0.5) / static_cast<double>(table.size());
      table[i] = {std::cos(angle), std::sin(angle)};
    }
    return table;
  }();
  return directions;
}

}  // namespace electron_step

}  // namespace cgemit

// Front-end chips: what a strip's current becomes (docs/methods/readout.md).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>

#include "common/rng.hpp"
#include "readout/shaper.hpp"

namespace cgemit {

// Step of the time grid, ns: small against the 50 ns of shaper and induction gap.
inline constexpr double time_step = 4.0;

// The steps of one strip's current, fC/ns, at the times of the grid.
struct CurrentSteps {
  const double* first;
  std::size_t n, apart = 1;
  double operator[](std::size_t i) const { return first[i * apart]; }
  std::size_t size() const { return n; }
};

enum class ChipKind { tiger, apv25 };

// Amplitudes are in fC: 1 fC that arrives at once has a peak of 1 fC behind either shaper.
struct Chip {
  ChipKind kind;
  Shaper timing, charge;            // APV25: the second one is not used
  std::array<double, 2> threshold;  // fC, of X and V strips
  double noise;                     // fC, standard deviation of an amplitude
  double jitter;                    // ns, standard deviation of the time
  double saturation;                // fC, largest charge
  double sample_delay;  // ns, TIGER: from the crossing of the threshold to the sample of the charge
  double clock;         // ns, APV25: between samples, the first one at time 0
  int samples;          // APV25
};

struct StripReading {
  double charge, time;  // fC, ns
};

// Current of one strip.
struct Current {
  CurrentSteps steps;
  double charge;  // fC; the integral up to any time is at most this
};

// What the chip makes of a current that begins at `start` (ns); nothing below the threshold. `response`: of
// the branch of the charge. Noise is that of (stream, gid).
std::optional<StripReading> measure(const Chip& chip, StepResponse& response, int view, double start,
                                    const Current& current, const Stream& stream, std::uint32_t gid);

}  // namespace cgemit

// Front-end chips: what a strip's current becomes, and when (docs/methods/readout.md). A chip is a struct on
// `ChipNumbers` with a name, `response`, `measure` and `delays`, and one of the alternatives of `Chip`.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <variant>

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

// What all chips have behind a strip. Amplitudes are in fC: 1 fC that arrives at once has a peak of 1 fC
// behind any shaper.
struct Amplifier {
  std::array<double, 2> threshold;  // fC, of X and V strips
  double noise;                     // fC, standard deviation of an amplitude
  double jitter;                    // ns, standard deviation of the time
  double saturation;                // fC, largest charge
};

// Numbers of a chip. Each kind reads some of them.
struct ChipNumbers {
  Amplifier amplifier;
  Shaper timing, charge;  // of the branches of the time and of the charge
  double sample_delay;    // ns, from the crossing of the threshold to the sample of the charge
  double clock;           // ns, between samples, the first one at time 0
  // 64 bits leave no padding, which GCC 12 clears at a wrong place (-ftrivial-auto-var-init of .ci/sanitize).
  std::int64_t samples;
};

struct StripReading {
  double charge, time;  // fC, ns
};

// Current of one strip, which begins at `start`.
struct Current {
  CurrentSteps steps;
  double charge;  // fC; the integral up to any time is at most this
  double start;   // ns
};

// Noise of one strip: normal numbers one after the other, of (stream, gid).
class NormalNoise {
 public:
  NormalNoise(const Stream& stream, std::uint32_t gid) : stream_(stream), gid_(gid) {}
  double next();

 private:
  const Stream& stream_;
  std::uint32_t gid_, block_ = 0;
  std::size_t used_ = 4;
  Block words_{};
};

// Charges whose times are looked up for a current of a charge of 1 in the end.
struct ChargesAbove {
  std::span<const double> charges;  // fC, growing
  double threshold;                 // fC
  double phase;                     // from 0 to 1, of a clock
};

// Branch T gives the time of the leading edge, and the amplitude of branch E is sampled a fixed time later.
// Both must exceed the threshold: the charge that is induced on a strip beside the avalanche, and goes again,
// hardly moves E. Noise moves the threshold, and with it the time as far as the slope makes it.
struct Tiger : ChipNumbers {
  static constexpr const char* name = "tiger";

  // To a step of the current, of the branch of the charge; `measure` takes it.
  StepResponse response() const { return {charge, time_step}; }
  // What the chip makes of a current; nothing below the threshold.
  std::optional<StripReading> measure(StepResponse& response, int view, const Current& current,
                                      NormalNoise noise) const;
  // The times, ns, at which the chip measures charges of a current.
  void delays(std::span<const double> steps, const ChargesAbove& of, std::span<double> times) const;
};

// Samples at fixed times: the charge is the largest one, the time that of half of it on the leading edge.
struct Apv25 : ChipNumbers {
  static constexpr const char* name = "apv25";

  StepResponse response() const { return {timing, time_step}; }
  std::optional<StripReading> measure(StepResponse& response, int view, const Current& current,
                                      NormalNoise noise) const;
  // The same for all charges, at one phase of the clock.
  void delays(std::span<const double> steps, const ChargesAbove& of, std::span<double> times) const;
};

using Chip = std::variant<Tiger, Apv25>;

// The chip of a name. Throws std::invalid_argument with all names if there is none.
Chip chip_of(const std::string& name, const ChipNumbers& numbers);

}  // namespace cgemit

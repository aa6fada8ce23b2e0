#include "readout/chips.hpp"

#include <algorithm>
#include <array>
#include <vector>

namespace cgemit {
namespace {

constexpr double after = 150;  // ns, in which the amplitude of a current that has ended may still rise

// Noise of one strip: normal numbers one after the other.
class NormalNoise {
 public:
  NormalNoise(const Stream& stream, std::uint32_t gid) : stream_(stream), gid_(gid) {}
  double next() {
    if (used_ == 4) {
      words_ = stream_.block(Purpose::readout_strip, gid_, block_++);
      used_ = 0;
    }
    return normal_quantile(open_unit(words_[used_++]));
  }

 private:
  const Stream& stream_;
  std::uint32_t gid_, block_ = 0;
  std::size_t used_ = 4;
  Block words_{};
};

double step_at(CurrentSteps steps, std::size_t i) { return i < steps.size() ? steps[i] : 0.0; }

// The first time of the grid with a current; the amplitude is 0 up to it.
std::size_t first_step(CurrentSteps steps) {
  std::size_t i = 0;
  while (i < steps.size() && steps[i] == 0) ++i;
  return i;
}

// Whether an amplitude may exceed a level, with `charge` the largest one on the strip at any time: responses
// to 1 fC are at most 1, up to the rounding of their peak.
bool may_exceed(double charge, double level) { return charge * (1 + 1e-6) > level; }

// Time from the start, in steps of the grid, at which the amplitude first exceeds a threshold; negative if
// never.
template <class Filter>
double crossing(Filter filter, CurrentSteps steps, double threshold) {
  const std::size_t end = steps.size() + static_cast<std::size_t>(after / time_step);
  double before = 0;
  for (std::size_t i = first_step(steps); i < end; ++i) {
    const double amplitude = filter.next(step_at(steps, i));
    if (amplitude > threshold) {
      return i == 0 ? 0 : static_cast<double>(i) - (amplitude - threshold) / (amplitude - before);
    }
    before = amplitude;
  }
  return -1;
}

// Amplitude at a time in steps of the grid, linear between them. `response`: to a step of the current.
double amplitude_at(StepResponse& response, CurrentSteps steps, double time) {
  const double place = std::max(time, 0.0);
  const auto whole = static_cast<std::size_t>(place);
  const double* unit = response.up_to(whole + 1);
  const std::size_t end = std::min(steps.size(), whole + 1);
  // Every other step in a sum of its own: sums do not wait for each other.
  std::array<double, 2> low{}, high{};
  std::size_t i = first_step(steps);
  for (; i + 1 < end; i += 2) {
    for (std::size_t k = 0; k < 2; ++k) {
      low[k] += steps[i + k] * unit[whole - i - k];
      high[k] += steps[i + k] * unit[whole + 1 - i - k];
    }
  }
  if (i < end) {
    low[0] += steps[i] * unit[whole - i];
    high[0] += steps[i] * unit[whole + 1 - i];
  }
  const double before = low[0] + low[1], after_it = high[0] + high[1];
  return before + (place - static_cast<double>(whole)) * (after_it - before);
}

// Branch T gives the time of the leading edge, and the amplitude of branch E is sampled a fixed time later.
// Both must exceed the threshold: the charge that is induced on a strip beside the avalanche, and goes again,
// hardly moves E. Noise moves the threshold, and with it the time as far as the slope makes it.
std::optional<StripReading> tiger(const Chip& chip, StepResponse& response, int view, double start,
                                  const Current& current, NormalNoise noise) {
  const double threshold =
      std::max(chip.threshold[static_cast<std::size_t>(view)] - chip.noise * noise.next(), 0.0);
  if (!may_exceed(current.charge, threshold)) return std::nullopt;
  const double crossed = filtered(chip.timing, time_step,
                                  [&](auto filter) { return crossing(filter, current.steps, threshold); });
  if (crossed < 0) return std::nullopt;
  const double fired = crossed * time_step + chip.timing.delay;  // ns after the start
  const double sampled = (fired + chip.sample_delay - chip.charge.delay) / time_step;
  const double charge = amplitude_at(response, current.steps, sampled) + chip.noise * noise.next();
  if (charge <= chip.threshold[static_cast<std::size_t>(view)]) return std::nullopt;
  return StripReading{std::min(charge, chip.saturation), start + fired + chip.jitter * noise.next()};
}

// Adds the amplitudes at the times of the samples.
template <class Filter>
void add_amplitudes(Filter filter, const Chip& chip, double start, CurrentSteps steps,
                    std::span<double> samples) {
  double low = 0, high = filter.next(step_at(steps, 0));
  std::size_t i = 0;  // `high` is the amplitude at this time of the grid
  for (std::size_t k = 0; k < samples.size(); ++k) {
    const double at = (static_cast<double>(k) * chip.clock - start - chip.timing.delay) / time_step;
    if (!(at > 0)) continue;
    while (static_cast<double>(i) < at) {
      low = high;
      high = filter.next(step_at(steps, ++i));
    }
    samples[k] += high + (static_cast<double>(i) - at) * (low - high);
  }
}

// Samples at fixed times: the charge is the largest one, the time that of half of it on the leading edge.
std::optional<StripReading> apv25(const Chip& chip, int view, double start, const Current& current,
                                  NormalNoise noise) {
  const double threshold = chip.threshold[static_cast<std::size_t>(view)];
  std::vector<double> samples(static_cast<std::size_t>(chip.samples));
  for (double& sample : samples) sample = chip.noise * noise.next();
  if (!may_exceed(current.charge, threshold - *std::ranges::max_element(samples))) return std::nullopt;
  filtered(chip.timing, time_step,
           [&](auto filter) { add_amplitudes(filter, chip, start, current.steps, samples); });
  const auto peak = std::ranges::max_element(samples);
  if (*peak <= threshold) return std::nullopt;
  auto above = peak;
  while (above != samples.begin() && *(above - 1) > 0.5 * *peak) --above;
  double at = static_cast<double>(above - samples.begin());
  if (above != samples.begin()) at -= (*above - 0.5 * *peak) / (*above - *(above - 1));
  return StripReading{std::min(*peak, chip.saturation), at * chip.clock + chip.jitter * noise.next()};
}

}  // namespace

std::optional<StripReading> measure(const Chip& chip, StepResponse& response, int view, double start,
                                    const Current& current, const Stream& stream, std::uint32_t gid) {
  const NormalNoise noise(stream, gid);
  return chip.kind == ChipKind::tiger ? tiger(chip, response, view, start, current, noise)
                                      : apv25(chip, view, start, current, noise);
}

}  // namespace cgemit

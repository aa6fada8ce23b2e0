#include "readout/chips.hpp"

#include <algorithm>
#include <array>
#include <stdexcept>
#include <string>
#include <vector>

namespace cgemit {
namespace {

constexpr double after = 150;       // ns, in which the amplitude of a current that has ended may still rise
constexpr double per_charge = 1.1;  // between charges for which a crossing is looked up

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

// Adds the amplitudes at the times of the samples.
template <class Filter>
void add_amplitudes(Filter filter, const Apv25& chip, const Current& current, std::span<double> samples) {
  double low = 0, high = filter.next(step_at(current.steps, 0));
  std::size_t i = 0;  // `high` is the amplitude at this time of the grid
  for (std::size_t k = 0; k < samples.size(); ++k) {
    const double at = (static_cast<double>(k) * chip.clock - current.start - chip.timing.delay) / time_step;
    if (!(at > 0)) continue;
    while (static_cast<double>(i) < at) {
      low = high;
      high = filter.next(step_at(current.steps, ++i));
    }
    samples[k] += high + (static_cast<double>(i) - at) * (low - high);
  }
}

void filter(const Shaper& shaper, std::span<const double> steps, std::vector<double>& amplitudes) {
  amplitudes.resize(steps.size());
  filtered(shaper, time_step, [&](auto one) {
    std::ranges::transform(steps, amplitudes.begin(), [&](double step) { return one.next(step); });
  });
}

// Amplitude at a time in steps, linear between them; that of the last one later.
double amplitude_at(const std::vector<double>& amplitudes, double time) {
  const double last = static_cast<double>(amplitudes.size() - 1), at = std::clamp(time, 0.0, last);
  const auto i = std::min(static_cast<std::size_t>(at), amplitudes.size() - 2);
  return amplitudes[i] + (at - static_cast<double>(i)) * (amplitudes[i + 1] - amplitudes[i]);
}

}  // namespace

double NormalNoise::next() {
  if (used_ == 4) {
    words_ = stream_.block(Purpose::readout_strip, gid_, block_++);
    used_ = 0;
  }
  return normal_quantile(open_unit(words_[used_++]));
}

std::optional<StripReading> Tiger::measure(StepResponse& response, int view, const Current& current,
                                           NormalNoise noise) const {
  const double limit = amplifier.threshold[static_cast<std::size_t>(view)];
  const double threshold = std::max(limit - amplifier.noise * noise.next(), 0.0);
  if (!may_exceed(current.charge, threshold)) return std::nullopt;
  const double crossed =
      filtered(timing, time_step, [&](auto one) { return crossing(one, current.steps, threshold); });
  if (crossed < 0) return std::nullopt;
  const double fired = crossed * time_step + timing.delay;  // ns after the start
  const double sampled = (fired + sample_delay - charge.delay) / time_step;
  const double read = amplitude_at(response, current.steps, sampled) + amplifier.noise * noise.next();
  if (read <= limit) return std::nullopt;
  return StripReading{std::min(read, amplifier.saturation),
                      current.start + fired + amplifier.jitter * noise.next()};
}

void Tiger::delays(std::span<const double> steps, const ChargesAbove& of, std::span<double> times) const {
  const std::span<const double> charges = of.charges;
  std::vector<double> edge, sampled;
  filter(timing, steps, edge);
  filter(charge, steps, sampled);
  std::size_t i = static_cast<std::size_t>(std::ranges::max_element(edge) - edge.begin());
  double given = 1.01 * of.threshold / edge[i];
  std::vector<double> risen(edge.begin(),
                            edge.begin() + static_cast<std::ptrdiff_t>(i) + 1);  // largest so far
  for (std::size_t k = 1; k <= i; ++k) risen[k] = std::max(risen[k], risen[k - 1]);
  std::size_t next = 0;
  double before = 0, last = 0;  // fC, ns
  // A current that never rises crosses no threshold.
  for (; next < charges.size() && given > 0 && given < 100 * charges.back(); given *= per_charge) {
    const double level = of.threshold / given;
    while (i > 0 && risen[i - 1] > level) --i;
    const double low = i > 0 ? edge[i - 1] : 0.0;
    const double crossed = static_cast<double>(i) - (edge[i] - level) / (edge[i] - low);
    const double fired = crossed * time_step + timing.delay;
    const double sample = (fired + sample_delay - charge.delay) / time_step;
    const double measured = given * amplitude_at(sampled, sample);
    for (; next < charges.size() && charges[next] <= measured; ++next) {
      const double share = before > 0 ? (charges[next] - before) / (measured - before) : 1.0;
      times[next] = last + share * (fired - last);
    }
    if (measured <= before) continue;
    before = measured;
    last = fired;
  }
  for (; next < charges.size(); ++next) times[next] = last;
}

std::optional<StripReading> Apv25::measure(StepResponse& /*response*/, int view, const Current& current,
                                           NormalNoise noise) const {
  const double threshold = amplifier.threshold[static_cast<std::size_t>(view)];
  std::vector<double> read(static_cast<std::size_t>(samples));
  for (double& sample : read) sample = amplifier.noise * noise.next();
  if (!may_exceed(current.charge, threshold - *std::ranges::max_element(read))) return std::nullopt;
  filtered(timing, time_step, [&](auto one) { add_amplitudes(one, *this, current, read); });
  const auto peak = std::ranges::max_element(read);
  if (*peak <= threshold) return std::nullopt;
  auto above = peak;
  while (above != read.begin() && *(above - 1) > 0.5 * *peak) --above;
  double at = static_cast<double>(above - read.begin());
  if (above != read.begin()) at -= (*above - 0.5 * *peak) / (*above - *(above - 1));
  return StripReading{std::min(*peak, amplifier.saturation), at * clock + amplifier.jitter * noise.next()};
}

void Apv25::delays(std::span<const double> steps, const ChargesAbove& of, std::span<double> times) const {
  std::vector<double> edge;
  filter(timing, steps, edge);
  const double ticks = clock / time_step, begin = of.phase * ticks;
  double top = 0;
  std::size_t best = 0;
  for (std::size_t k = 0; static_cast<double>(k) * ticks + begin < static_cast<double>(edge.size()); ++k) {
    const double sample = amplitude_at(edge, static_cast<double>(k) * ticks + begin);
    if (sample > top) {
      top = sample;
      best = k;
    }
  }
  double above = top;
  std::size_t k = best;
  const auto sample_before = [&](std::size_t one) {
    return one == 0 ? 0.0 : amplitude_at(edge, static_cast<double>(one - 1) * ticks + begin);
  };
  while (sample_before(k) > 0.5 * top) above = sample_before(k--);
  const double at = static_cast<double>(k) - (above - 0.5 * top) / (above - sample_before(k));
  std::ranges::fill(times, (at * ticks + begin) * time_step + timing.delay);
}

namespace {

template <std::size_t i = 0>
Chip chip_from(const std::string& name, const ChipNumbers& numbers, const std::string& known) {
  if constexpr (i < std::variant_size_v<Chip>) {
    using Kind = std::variant_alternative_t<i, Chip>;
    if (name == Kind::name) return Kind{numbers};
    return chip_from<i + 1>(name, numbers, known + (i > 0 ? " or " : "") + Kind::name);
  } else {
    throw std::invalid_argument("chip kind: got " + name + ", expected " + known);
  }
}

}  // namespace

Chip chip_of(const std::string& name, const ChipNumbers& numbers) { return chip_from(name, numbers, ""); }

}  // namespace cgemit

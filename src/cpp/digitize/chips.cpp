#include "digitize/chips.hpp"

#include <algorithm>
#include <vector>

#include "digitize/strip_signals.hpp"

namespace cgemit {
namespace {

constexpr double after = 150;  // ns, in which the amplitude of a current that has ended may still rise

// Noise of one strip: normal numbers one after the other.
class StripNoise {
 public:
  StripNoise(const Stream& stream, std::uint32_t gid) : stream_(stream), gid_(gid) {}
  double next() {
    if (used_ == 4) {
      numbers_ = stream_.normals(Purpose::readout_strip, gid_, block_++);
      used_ = 0;
    }
    return numbers_[used_++];
  }

 private:
  const Stream& stream_;
  std::uint32_t gid_, block_ = 0;
  std::size_t used_ = 4;
  std::array<double, 4> numbers_{};
};

double step_at(std::span<const double> steps, std::size_t i) { return i < steps.size() ? steps[i] : 0.0; }

// Time from the start, in steps of the grid, at which the amplitude first exceeds a threshold; negative if
// never.
double crossing(const Shaper& shaper, std::span<const double> steps, double threshold) {
  StepFilter filter(shaper, time_step);
  const std::size_t end = steps.size() + static_cast<std::size_t>(after / time_step);
  double before = 0;
  for (std::size_t i = 0; i < end; ++i) {
    const double amplitude = filter.next(step_at(steps, i));
    if (amplitude > threshold) {
      return i == 0 ? 0 : static_cast<double>(i) - (amplitude - threshold) / (amplitude - before);
    }
    before = amplitude;
  }
  return -1;
}

// Amplitude at a time in steps of the grid, linear between them.
double amplitude_at(const Shaper& shaper, std::span<const double> steps, double time) {
  StepFilter filter(shaper, time_step);
  const double place = std::max(time, 0.0);
  const auto whole = static_cast<std::size_t>(place);
  double low = 0, high = 0;
  for (std::size_t i = 0; i <= whole + 1; ++i) {
    low = high;
    high = filter.next(step_at(steps, i));
  }
  return low + (place - static_cast<double>(whole)) * (high - low);
}

// Branch T gives the time of the leading edge, and the amplitude of branch E is sampled a fixed time later.
// Noise moves the threshold, and with it the time as far as the slope makes it.
std::optional<Measured> tiger(const Chip& chip, int view, double start, std::span<const double> steps,
                              StripNoise noise) {
  const double threshold =
      std::max(chip.threshold[static_cast<std::size_t>(view)] - chip.noise * noise.next(), 0.0);
  const double crossed = crossing(chip.timing, steps, threshold);
  if (crossed < 0) return std::nullopt;
  const double fired = crossed * time_step + chip.timing.delay;  // ns after the start
  const double sampled = (fired + chip.sample_delay - chip.charge.delay) / time_step;
  const double charge = amplitude_at(chip.charge, steps, sampled) + chip.noise * noise.next();
  return Measured{std::clamp(charge, 0.0, chip.saturation), start + fired + chip.jitter * noise.next()};
}

// Samples at fixed times: the charge is the largest one, the time that of half of it on the leading edge.
std::optional<Measured> apv25(const Chip& chip, int view, double start, std::span<const double> steps,
                              StripNoise noise) {
  StepFilter filter(chip.timing, time_step);
  std::vector<double> samples;
  double low = 0, high = filter.next(step_at(steps, 0));
  std::size_t i = 0;  // `high` is the amplitude at this time of the grid
  for (int k = 0; k < chip.samples; ++k) {
    const double at = (k * chip.clock - start - chip.timing.delay) / time_step;
    double amplitude = 0;
    if (at > 0) {
      while (static_cast<double>(i) < at) {
        low = high;
        high = filter.next(step_at(steps, ++i));
      }
      amplitude = high + (static_cast<double>(i) - at) * (low - high);
    }
    samples.push_back(amplitude + chip.noise * noise.next());
  }
  const auto peak = std::ranges::max_element(samples);
  if (*peak <= chip.threshold[static_cast<std::size_t>(view)]) return std::nullopt;
  auto above = peak;
  while (above != samples.begin() && *(above - 1) > 0.5 * *peak) --above;
  double at = static_cast<double>(above - samples.begin());
  if (above != samples.begin()) at -= (*above - 0.5 * *peak) / (*above - *(above - 1));
  return Measured{std::min(*peak, chip.saturation), at * chip.clock + chip.jitter * noise.next()};
}

}  // namespace

std::optional<Measured> measure(const Chip& chip, int view, double start, std::span<const double> steps,
                                const Stream& stream, std::uint32_t gid) {
  const StripNoise noise(stream, gid);
  return chip.kind == ChipKind::tiger ? tiger(chip, view, start, steps, noise)
                                      : apv25(chip, view, start, steps, noise);
}

}  // namespace cgemit

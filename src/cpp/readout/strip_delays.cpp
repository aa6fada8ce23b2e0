#include "readout/strip_delays.hpp"

#include <algorithm>
#include <cmath>

namespace cgemit {
namespace {

constexpr double tail = 250;           // ns, in which amplitudes are followed after the current
constexpr double least = 0.3;          // charge of a strip, in those of an electron
constexpr double per_charge = 1.1;     // between charges for which a crossing is looked up
constexpr double golden = 0.61803399;  // spreads the phases of a clock

// The current of one strip for a charge of 1 in the end, and the mean arrival of this charge.
class StripCurrent {
 public:
  StripCurrent(const StripView& view) : view_(view) {
    const double longest = view.gap / view.velocity + view.duration;
    steps_.resize(static_cast<std::size_t>((longest + tail) / time_step) + 3);
  }

  // Whether the strip has charge of the track.
  bool set(const DriftingTracks& tracks, std::size_t track, double slope) {
    std::ranges::fill(steps_, 0.0);
    charge_ = mean_ = 0;
    const double strip = (std::abs(slope) * view_.gap + view_.margin) * tracks.place[track];
    for (auto i = static_cast<std::size_t>(tracks.first[track]);
         i < static_cast<std::size_t>(tracks.first[track + 1]); ++i) {
      const double height = view_.gap * tracks.height[i];
      add(slope * height - strip, (0.5 * view_.gap - height) / view_.velocity, tracks.charge[i]);
    }
    if (charge_ < least) return false;
    mean_ /= charge_;
    for (double& step : steps_) step /= charge_;
    return true;
  }

  const std::vector<double>& steps() const { return steps_; }
  double charge() const { return charge_; }
  double mean() const { return mean_; }  // ns

 private:
  // A charge beside the strip (mm) that reaches the induction gap at a time (ns).
  void add(double beside, double time, double charge) {
    constexpr std::size_t nodes = InducedCharge::nodes;
    const InducedCharge& table = view_.induced;
    const double position = beside / view_.pitch + 0.5, whole = std::floor(position);
    const double strip = static_cast<double>(table.reach) - whole;
    if (!(strip >= 0 && strip < static_cast<double>(table.strips()))) return;
    const double place = (position - whole) * static_cast<double>(table.phases);
    const std::size_t below = std::min(static_cast<std::size_t>(place), table.phases - 1);
    const double* const low = &table.charge[below * nodes * table.strips() + static_cast<std::size_t>(strip)];
    const double* const high = low + nodes * table.strips();
    const auto at = [&](std::size_t k) {
      const double one = low[k * table.strips()], other = high[k * table.strips()];
      return charge * (one + (place - static_cast<double>(below)) * (other - one));
    };
    double before = 0;
    for (std::size_t k = 0; k < nodes; ++k) {
      const double current =
          k + 1 < nodes ? (at(k + 1) - at(k)) / ((table.way[k + 1] - table.way[k]) * view_.duration) : 0.0;
      const double when = (time + table.way[k] * view_.duration) / time_step, begin = std::floor(when);
      const double late = (current - before) * (when - begin);
      const auto i = static_cast<std::size_t>(begin);
      steps_[i] += current - before - late;
      steps_[i + 1] += late;
      before = current;
    }
    charge_ += at(nodes - 1);
    mean_ += at(nodes - 1) * time;
  }

  const StripView& view_;
  std::vector<double> steps_;  // fC/ns, from the first possible arrival on
  double charge_ = 0, mean_ = 0;
};

void filter(const Shaper& shaper, const std::vector<double>& steps, std::vector<double>& amplitudes) {
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

class Delays {
 public:
  Delays(const Chip& chip, const StripView& view, std::span<const double> charges)
      : chip_(chip), view_(view), charges_(charges), delays_(charges.size()) {}

  // Sets the delays of the charges for a current: the leading edge of branch T, by the charge that branch E
  // has a fixed time later.
  void tiger(const StripCurrent& current) {
    filter(chip_.timing, current.steps(), edge_);
    filter(chip_.charge, current.steps(), sampled_);
    std::size_t i = static_cast<std::size_t>(std::ranges::max_element(edge_) - edge_.begin());
    double charge = 1.01 * view_.threshold / edge_[i];
    risen_.assign(edge_.begin(), edge_.begin() + static_cast<std::ptrdiff_t>(i) + 1);
    for (std::size_t k = 1; k <= i; ++k) risen_[k] = std::max(risen_[k], risen_[k - 1]);
    std::size_t next = 0;
    double before = 0, last = 0;  // fC, ns
    for (; next < charges_.size() && charge < 100 * charges_.back(); charge *= per_charge) {
      const double level = view_.threshold / charge;
      while (i > 0 && risen_[i - 1] > level) --i;
      const double low = i > 0 ? edge_[i - 1] : 0.0;
      const double crossed = static_cast<double>(i) - (edge_[i] - level) / (edge_[i] - low);
      const double fired = crossed * time_step + chip_.timing.delay;
      const double sample = (fired + chip_.sample_delay - chip_.charge.delay) / time_step;
      const double measured = charge * amplitude_at(sampled_, sample);
      for (; next < charges_.size() && charges_[next] <= measured; ++next) {
        const double share = before > 0 ? (charges_[next] - before) / (measured - before) : 1.0;
        delays_[next] = last + share * (fired - last) - current.mean();
      }
      if (measured <= before) continue;
      before = measured;
      last = fired;
    }
    for (; next < charges_.size(); ++next) delays_[next] = last - current.mean();
  }

  // The time at which samples reach half of the largest one, at one phase of the clock: of all charges.
  void apv25(const StripCurrent& current, double phase) {
    filter(chip_.timing, current.steps(), edge_);
    const double clock = chip_.clock / time_step, begin = phase * clock;
    double top = 0;
    std::size_t best = 0;
    for (std::size_t k = 0; static_cast<double>(k) * clock + begin < static_cast<double>(edge_.size()); ++k) {
      const double sample = amplitude_at(edge_, static_cast<double>(k) * clock + begin);
      if (sample > top) {
        top = sample;
        best = k;
      }
    }
    double above = top;
    std::size_t k = best;
    const auto sample_before = [&](std::size_t one) {
      return one == 0 ? 0.0 : amplitude_at(edge_, static_cast<double>(one - 1) * clock + begin);
    };
    while (sample_before(k) > 0.5 * top) above = sample_before(k--);
    const double at = static_cast<double>(k) - (above - 0.5 * top) / (above - sample_before(k));
    std::ranges::fill(delays_, (at * clock + begin) * time_step + chip_.timing.delay - current.mean());
  }

  const std::vector<double>& of_charges() const { return delays_; }

 private:
  const Chip& chip_;
  const StripView& view_;
  std::span<const double> charges_;
  std::vector<double> delays_;                  // ns, of the charges
  std::vector<double> edge_, risen_, sampled_;  // amplitudes; the largest one so far
};

}  // namespace

std::vector<double> strip_delays(const Chip& chip, const StripView& view, const DriftingTracks& tracks,
                                 std::span<const double> slopes, std::span<const double> charges) {
  std::vector<double> found(slopes.size() * charges.size());
  StripCurrent current(view);
  Delays delays(chip, view, charges);
  for (std::size_t s = 0; s < slopes.size(); ++s) {
    const std::span<double> row(&found[s * charges.size()], charges.size());
    double weight = 0;
    for (std::size_t track = 0; track < tracks.place.size(); ++track) {
      if (!current.set(tracks, track, slopes[s])) continue;
      if (chip.kind == ChipKind::tiger) {
        delays.tiger(current);
      } else {
        delays.apv25(current, std::fmod(golden * static_cast<double>(track), 1.0));
      }
      weight += current.charge();
      for (std::size_t k = 0; k < row.size(); ++k) row[k] += current.charge() * delays.of_charges()[k];
    }
    if (weight > 0) {
      for (double& delay : row) delay /= weight;
    }
  }
  return found;
}

}  // namespace cgemit

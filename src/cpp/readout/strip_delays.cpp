#include "readout/strip_delays.hpp"

#include <algorithm>
#include <cmath>

namespace cgemit {
namespace {

constexpr double tail = 250;           // ns, in which amplitudes are followed after the current
constexpr double least = 0.3;          // charge of a strip, in those of an electron
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

}  // namespace

std::vector<double> strip_delays(const Chip& chip, const StripView& view, const DriftingTracks& tracks,
                                 std::span<const double> slopes, std::span<const double> charges) {
  std::vector<double> found(slopes.size() * charges.size());
  StripCurrent current(view);
  std::vector<double> times(charges.size());
  for (std::size_t s = 0; s < slopes.size(); ++s) {
    const std::span<double> row(&found[s * charges.size()], charges.size());
    double weight = 0;
    for (std::size_t track = 0; track < tracks.place.size(); ++track) {
      if (!current.set(tracks, track, slopes[s])) continue;
      const ChargesAbove of{charges, view.threshold, std::fmod(golden * static_cast<double>(track), 1.0)};
      std::visit([&](const auto& one) { one.delays(current.steps(), of, times); }, chip);
      weight += current.charge();
      for (std::size_t k = 0; k < row.size(); ++k) row[k] += current.charge() * (times[k] - current.mean());
    }
    if (weight > 0) {
      for (double& delay : row) delay /= weight;
    }
  }
  return found;
}

}  // namespace cgemit

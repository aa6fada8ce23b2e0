// Induced currents on the strips of one layer in one event, as histograms in time, and who caused them.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <span>
#include <stdexcept>
#include <vector>

#include "common/problems.hpp"
#include "detector/detector.hpp"

namespace cgemit {

// Step of the time grid, ns: small against the 50 ns of shaper and induction gap.
inline constexpr double time_step = 2.0;
// Of an event: 0.2 ms, a hundred lives of a muon. Each strip with a current has the whole grid, and a chip
// filters from the begin or from time 0.
inline constexpr double most_steps = 1e5;

// A strip with a current. Histograms hold the steps of the current, fC/ns, at the times of the grid.
class StripSignals {
 public:
  // The truth with the largest charge on a strip; truths come one after the other.
  struct Source {
    std::int64_t truth = -1, largest_truth = -1;
    double charge = 0, largest = -1, total = 0;  // fC; of the current truth, of the largest one, of all
    std::int32_t n = 0;

    // Ends the current truth and begins another one.
    void open(std::int64_t next) {
      close();
      truth = next;
      ++n;
    }
    // Ends the current truth.
    void close() {
      if (n == 0) return;
      total += charge;
      if (charge > largest) {
        largest = charge;
        largest_truth = truth;
      }
      charge = 0;
    }
  };

  explicit StripSignals(const CgemLayer& layer)
      : layer_(&layer),
        slot_of_(static_cast<std::size_t>(layer.sheets) *
                     static_cast<std::size_t>(layer.strips_x + layer.strips_v),
                 -1) {}

  // Forgets all currents; those to come arrive between two times (ns) and last as long as the induction gap.
  void begin(double first, double last, double induction) {
    for (const std::int32_t strip : strips_) slot_of_[static_cast<std::size_t>(strip)] = -1;
    strips_.clear();
    sources_.clear();
    steps_.clear();
    start_ = first;
    induction_ = induction / time_step;
    per_time_ = 1 / induction;
    last_ = (last - first) / time_step;
    if (!(last_ + induction_ + std::max(0.0, -first / time_step) <= most_steps))
      throw std::invalid_argument("currents of an event on a layer from " + to_text(first) + " to " +
                                  to_text(last + induction) + " ns: expected a range of at most " +
                                  to_text(most_steps * time_step) + " ns, and no earlier begin");
    bins_ = static_cast<std::size_t>(last_ + induction_) + 3;
  }

  // When a charge enters and leaves the induction gap, on the grid.
  struct Transit {
    std::size_t enters, leaves;
    double after_enters, after_leaves;  // share of the step that falls to the next time
  };
  Transit transit(double time) const {
    const double at = std::clamp((time - start_) / time_step, 0.0, last_), end = at + induction_;
    const auto enters = static_cast<std::size_t>(at), leaves = static_cast<std::size_t>(end);
    return {enters, leaves, at - static_cast<double>(enters), end - static_cast<double>(leaves)};
  }

  // Charges that cross the induction gap at constant velocity, rectangular currents: `parts` of `charge` (fC)
  // on consecutive strips. Steps are shared between neighbouring times, so that their mean time is exact.
  void add(int sheet, int view, int strip, std::span<const double> parts, const Transit& at, double charge,
           std::int64_t truth) {
    const double rate = charge * per_time_;
    const std::array<double, 2> enter = {rate * (1 - at.after_enters), rate * at.after_enters};
    const std::array<double, 2> leave = {rate * (1 - at.after_leaves), rate * at.after_leaves};
    const std::int32_t first = local(sheet, view, strip);
    for (std::size_t i = 0; i < parts.size(); ++i) {
      const std::size_t slot = slot_of(first + static_cast<std::int32_t>(i));
      const double part = parts[i];
      Source& source = sources_[slot];
      if (source.truth != truth) source.open(truth);
      source.charge += part * charge;
      double* entering = &steps_[slot * bins_ + at.enters];
      double* leaving = &steps_[slot * bins_ + at.leaves];
      entering[0] += part * enter[0];
      entering[1] += part * enter[1];
      leaving[0] -= part * leave[0];
      leaving[1] -= part * leave[1];
    }
  }

  // Ends the last truth of every strip.
  void close() {
    for (Source& source : sources_) source.close();
  }

  // Adds a share of every strip's current to its neighbours at a distance of one and of two strips.
  void couple(double first, double second) {
    if (first == 0 && second == 0) return;
    const std::vector<std::int32_t> strips = strips_;
    const std::vector<double> steps = steps_;
    const std::vector<Source> sources = sources_;
    const int per_sheet = layer_->strips_x + layer_->strips_v;
    for (std::size_t i = 0; i < strips.size(); ++i) {
      const int in_sheet = strips[i] % per_sheet, view = in_sheet >= layer_->strips_x;
      const int low = strips[i] - in_sheet + (view ? layer_->strips_x : 0);
      const int high = low + (view ? layer_->strips_v : layer_->strips_x);
      for (const auto& [distance, share] : {std::pair(1, first), std::pair(2, second)}) {
        for (const int strip : {strips[i] - distance, strips[i] + distance}) {
          if (strip < low || strip >= high || share == 0) continue;
          const std::size_t slot = slot_of(strip);
          Source& source = sources_[slot];
          if (source.n == 0) source.largest_truth = sources[i].largest_truth, source.n = 1;
          source.total += share * sources[i].total;
          for (std::size_t b = 0; b < bins_; ++b) steps_[slot * bins_ + b] += share * steps[i * bins_ + b];
        }
      }
    }
  }

  // Calls read(sheet, view, strip, source, steps) for each strip with a current, in order.
  template <class Read>
  void each(Read&& read) {
    std::sort(strips_.begin(), strips_.end());
    const int per_sheet = layer_->strips_x + layer_->strips_v;
    for (const std::int32_t one : strips_) {
      const std::size_t slot = static_cast<std::size_t>(slot_of_[static_cast<std::size_t>(one)]);
      const int sheet = one / per_sheet, in_sheet = one % per_sheet, view = in_sheet >= layer_->strips_x;
      read(sheet, view, in_sheet - (view ? layer_->strips_x : 0), sources_[slot],
           std::span<const double>(&steps_[slot * bins_], bins_));
    }
  }
  double start() const { return start_; }  // ns, time of the first step

 private:
  std::int32_t local(int sheet, int view, int strip) const {
    return sheet * (layer_->strips_x + layer_->strips_v) + (view == 0 ? 0 : layer_->strips_x) + strip;
  }
  std::size_t slot_of(std::int32_t strip) {
    std::int32_t& slot = slot_of_[static_cast<std::size_t>(strip)];
    if (slot < 0) {
      slot = static_cast<std::int32_t>(strips_.size());
      strips_.push_back(strip);
      sources_.emplace_back();
      steps_.resize(steps_.size() + bins_, 0.0);
    }
    return static_cast<std::size_t>(slot);
  }
  const CgemLayer* layer_;
  std::vector<std::int32_t> slot_of_, strips_;  // slot of each strip or -1; strips in order of their slots
  std::vector<Source> sources_;
  std::vector<double> steps_;  // fC/ns, one histogram a slot
  std::size_t bins_ = 0;
  double start_ = 0, induction_ = 0, last_ = 0, per_time_ = 0;  // ns; steps of the grid; 1/ns
};

}  // namespace cgemit

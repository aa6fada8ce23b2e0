// Induced currents on the strips of one layer in one event, as histograms in time, and who caused them.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <span>
#include <stdexcept>
#include <type_traits>
#include <vector>

#include "common/lanes/pack.hpp"
#include "common/problems.hpp"
#include "detector/detector.hpp"
#include "readout/chips.hpp"
#include "readout/induced_charge.hpp"

namespace cgemit {

// Steps of an event: 0.4 ms, hundreds of lives of a muon. Each strip with a current has the whole grid, and a
// chip filters from the begin or from time 0.
inline constexpr double longest_grid = 1e5;

// Strips in blocks, side by side in the lanes of T. Histograms hold the steps of the current, fC/ns, at the
// times of the grid.
template <class T>
class StripSignals {
 public:
  static constexpr int block = 4;  // strips
  // The truth that induced most of a strip's charge; truths come one after the other.
  struct Source {
    std::int64_t largest_truth = -1;
    double largest = -1, total = 0;  // fC; at any time a strip has at most `total`
    std::int32_t n = 0;
  };

  StripSignals(const MeasuringLayer& layer, std::size_t number, std::size_t layers,
               const InducedCharge& induced, double induction)
      : layer_(&layer),
        reach_(static_cast<int>(induced.reach)),
        strips_(induced.strips()),
        phases_(induced.phases),
        way_(induced.way),
        induction_(induction / time_step),
        blocks_{blocks_of(layer.strips_x), blocks_of(layer.strips_v)},
        slot_of_(static_cast<std::size_t>(layer.sheets * (blocks_[0] + blocks_[1])), -1) {
    for (std::size_t view = 0; view < 2; ++view) {
      const std::size_t plane = view * layers + number;
      fill(view, induced.charge.subspan(plane * induced.plane_size(), induced.plane_size()), induction);
    }
  }

  // Forgets all currents; those to come begin between two times (ns).
  void begin(double first, double last) {
    for (const std::int32_t one : used_) slot_of_[static_cast<std::size_t>(one)] = -1;
    used_.clear();
    sources_.clear();
    steps_.clear();
    charges_.clear();
    open_.clear();
    of_truth_.clear();
    start_ = first;
    last_ = (last - first) / time_step;
    if (!(last_ + induction_ + std::max(0.0, -first / time_step) <= longest_grid))
      throw std::invalid_argument("currents of an event on a layer from " + to_text(first) + " to " +
                                  to_text(last + induction_ * time_step) +
                                  " ns: expected a range of at most " + to_text(longest_grid * time_step) +
                                  " ns, and no earlier begin");
    bins_ = static_cast<std::size_t>(last_ + induction_) + 3;
  }

  // When a charge passes the nodes of the induction gap, on the grid.
  struct Transit {
    std::array<std::size_t, InducedCharge::nodes> at;
    std::array<double, InducedCharge::nodes> after;  // share of the step that falls to the next time
  };
  Transit transit(double time) const {
    const double enters = std::clamp((time - start_) / time_step, 0.0, last_);
    Transit found;
    for (std::size_t k = 0; k < InducedCharge::nodes; ++k) {
      const double at = enters + way_[k] * induction_;
      found.at[k] = static_cast<std::size_t>(at);
      found.after[k] = at - static_cast<double>(found.at[k]);
    }
    return found;
  }

  // Strips that an avalanche at a position in strips induces charge on.
  int first_strip(double position) const { return static_cast<int>(std::floor(position)) - reach_; }
  std::size_t strips() const { return strips_; }

  // Factors on the charge of strips, from the one `reach` strips before the avalanche's on.
  using Factors = std::span<const double>;

  // A charge (fC) that crosses the induction gap at constant velocity, at a position in strips. Steps are
  // shared between neighbouring times, so that their mean time is exact. `factors`: empty, or one for each
  // strip.
  void add(int sheet, int view, double position, double charge, const Transit& at, Factors factors = {}) {
    const double whole = std::floor(position), place = (position - whole) * static_cast<double>(phases_);
    const std::size_t below = std::min(static_cast<std::size_t>(place), phases_ - 1);
    const double* const row = rows_[static_cast<std::size_t>(view)].data() + below * rows * padded();
    const Between between{row, row + rows * padded(), place - static_cast<double>(below)};
    const int first = first_strip(position), last = first + static_cast<int>(strips_) - 1;
    const int end = std::min(last / block, blocks_[static_cast<std::size_t>(view)] - 1);
    for (int one = std::max(first, 0) / block; one <= end && last >= 0; ++one) {
      std::array<double, block> share;
      share.fill(charge);
      const int from = one * block - first;  // may be negative
      if (!factors.empty()) {
        for (int i = 0; i < block; ++i) {
          const int strip = std::clamp(from + i, 0, static_cast<int>(strips_) - 1);
          share[static_cast<std::size_t>(i)] *= factors[static_cast<std::size_t>(strip)];
        }
      }
      add_block(slot_of(sheet, view, one), between, static_cast<std::size_t>(block + from), share, at);
    }
  }

  // Ends a truth: what was added since the last one is of row `truth`.
  void close(std::int64_t truth) {
    for (const std::size_t slot : of_truth_) {
      for (std::size_t i = slot * block; i < (slot + 1) * block; ++i) {
        const double charge = charges_[i];
        charges_[i] = 0;
        if (charge < least_charge) continue;
        Source& source = sources_[i];
        source.total += charge;
        ++source.n;
        if (charge > source.largest) {
          source.largest = charge;
          source.largest_truth = truth;
        }
      }
      open_[slot] = false;
    }
    of_truth_.clear();
  }

  // Calls read(sheet, view, strip, source, steps) for each strip with a current, in order; steps are
  // `CurrentSteps`.
  template <class Read>
  void each(Read&& read) {
    std::sort(used_.begin(), used_.end());
    const int per_sheet = blocks_[0] + blocks_[1];
    for (const std::int32_t one : used_) {
      const auto slot = static_cast<std::size_t>(slot_of_[static_cast<std::size_t>(one)]);
      const int sheet = one / per_sheet, in_sheet = one % per_sheet, view = in_sheet >= blocks_[0];
      const int first = block * (in_sheet - (view ? blocks_[0] : 0));
      const int n = std::min(block, (view ? layer_->strips_v : layer_->strips_x) - first);
      for (int i = 0; i < n; ++i) {
        const Source& source = sources_[slot * block + static_cast<std::size_t>(i)];
        if (source.n == 0) continue;
        const double* const steps = &steps_[slot * bins_ * block + static_cast<std::size_t>(i)];
        read(sheet, view, first + i, source, CurrentSteps{steps, bins_, block});
      }
    }
  }
  double start() const { return start_; }  // ns, time of the first step

 private:
  static constexpr double least_charge = 1e-3;  // fC, of a truth on a strip
  static constexpr std::size_t rows =
      InducedCharge::nodes + 1;  // a step at each node, and the largest charge

  using Some = std::conditional_t<(lanes_of<T> > block), Pack<4>, T>;  // strips side by side

  // Between two places within a strip.
  struct Between {
    const double *low, *high;
    double share;
  };

  static int blocks_of(int strips) { return (strips + block - 1) / block; }
  std::size_t padded() const { return strips_ + 2 * block; }

  // Steps of the current at the nodes and the largest charge, with room for blocks that begin beside the
  // strips.
  void fill(std::size_t view, std::span<const double> charge, double induction) {
    constexpr std::size_t nodes = InducedCharge::nodes;
    std::vector<double>& out = rows_[view];
    out.assign((phases_ + 1) * rows * padded(), 0.0);
    for (std::size_t place = 0; place <= phases_; ++place) {
      for (std::size_t strip = 0; strip < strips_; ++strip) {
        const auto at = [&](std::size_t k) { return charge[(place * nodes + k) * strips_ + strip]; };
        double* const column = &out[place * rows * padded() + block + strip];
        double before = 0, largest = at(0);
        for (std::size_t k = 0; k < nodes; ++k) {
          const double current =
              k + 1 < nodes ? (at(k + 1) - at(k)) / ((way_[k + 1] - way_[k]) * induction) : 0.0;
          column[k * padded()] = current - before;
          before = current;
          largest = std::max(largest, at(k));
        }
        column[nodes * padded()] = largest;
      }
    }
  }

  void add_block(std::size_t slot, const Between& between, std::size_t offset,
                 const std::array<double, block>& charge, const Transit& at) {
    double* const steps = &steps_[slot * bins_ * block];
    double* const sum = &charges_[slot * block];
    for (std::size_t i = 0; i < block; i += lanes_of<Some>) {
      const Some whole = loaded<Some>(&charge[i]);
      const auto part = [&](std::size_t row) {
        const Some low = loaded<Some>(between.low + row * padded() + offset + i);
        const Some high = loaded<Some>(between.high + row * padded() + offset + i);
        return whole * (low + between.share * (high - low));
      };
      for (std::size_t k = 0; k < InducedCharge::nodes; ++k) {
        double* const now = steps + at.at[k] * block + i;
        const Some step = part(k), late = at.after[k] * step;
        store(loaded<Some>(now) + (step - late), now);
        store(loaded<Some>(now + block) + late, now + block);
      }
      store(loaded<Some>(sum + i) + part(InducedCharge::nodes), sum + i);
    }
  }

  std::size_t slot_of(int sheet, int view, int number) {
    const int local = sheet * (blocks_[0] + blocks_[1]) + (view == 0 ? 0 : blocks_[0]) + number;
    std::int32_t& found = slot_of_[static_cast<std::size_t>(local)];
    if (found < 0) {
      found = static_cast<std::int32_t>(used_.size());
      used_.push_back(local);
      sources_.resize(sources_.size() + block);
      charges_.resize(charges_.size() + block, 0.0);
      steps_.resize(steps_.size() + bins_ * block, 0.0);
      open_.push_back(false);
    }
    const auto slot = static_cast<std::size_t>(found);
    if (!open_[slot]) {
      open_[slot] = true;
      of_truth_.push_back(slot);
    }
    return slot;
  }

  const MeasuringLayer* layer_;
  int reach_;
  std::size_t strips_, phases_;
  std::array<double, InducedCharge::nodes> way_;
  double induction_;                          // steps of the grid
  std::array<std::vector<double>, 2> rows_;   // of X and V: (phases + 1, rows, padded)
  std::array<int, 2> blocks_;                 // of a sheet
  std::vector<std::int32_t> slot_of_, used_;  // slot of each block or -1; blocks in order of their slots
  std::vector<Source> sources_;               // of each strip of a slot
  std::vector<double> charges_;               // fC, largest ones induced by the truth that is open
  std::vector<char> open_;                    // whether a slot has some of them
  std::vector<std::size_t> of_truth_;         // these slots
  std::vector<double> steps_;                 // fC/ns, (slots, bins, block)
  std::size_t bins_ = 0;
  double start_ = 0, last_ = 0;  // ns; steps of the grid
};

}  // namespace cgemit

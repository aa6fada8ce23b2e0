// The simulation with particles side by side in SIMD lanes: the same draws as one by one, numbers equal but
// for rounding. What lanes do not do (electrons, particles that begin inward, foils with holes) is done one
// by one.
#pragma once

#include <algorithm>
#include <vector>

#include "matter/electron_flight.hpp"
#include "matter/ionization.hpp"
#include "simulate/lane_flight.hpp"
#include "simulate/simulate.hpp"

namespace cgemit {

inline bool for_lanes(const Detector& detector, const ParticleColumns& in, std::size_t row) {
  if (in.charge[row] == 0 || (in.px[row] == 0 && in.py[row] == 0)) return false;
  if (in.mass[row] < 2 * electron_mass) return false;
  const bool outward = in.x[row] * in.px[row] + in.y[row] * in.py[row] >= 0;
  return outward || std::hypot(in.x[row], in.y[row]) < detector.places.front().radius;
}

// Particles in consecutive rows, in groups that fly side by side; enough of them for the delta electrons to
// fill lanes of their own. What becomes of a particle does not depend on its companions.
template <class T>
class SimulatedChunk {
 public:
  SimulatedChunk(const Detector& detector, const ParticleColumns& in, const SimulateSettings& settings,
                 std::uint64_t seed, Simulated& out)
      : detector_(detector), in_(in), settings_(settings), seed_(seed), out_(out) {}

  // From a row on; returns the first row that is left.
  std::size_t run(std::size_t first) {
    const std::size_t end = choose_rows(first);
    const bool all_fly = rows_.size() == end - first;
    electrons_.clear();
    clusters_.clear();
    filled_.clear();
    for (std::size_t i = 0; i < rows_.size(); i += width) {
      // Written at once, cells leave the memory nearest to the processor to the next group.
      Group& group = groups_[i / width];
      std::vector<CellLanes<T>>& cells = all_fly ? groups_[0].cells : group.cells;
      fly(group, cells, i);
      for (std::size_t k = i; all_fly && k < std::min(i + width, rows_.size()); ++k)
        append_cells(cells, static_cast<int>(k - i), who(rows_[k]), out_.wire_truths);
    }
    ElectronFlight<T>(electrons_).run();
    next_filled_ = next_cluster_ = 0;
    std::size_t next = 0;
    for (std::size_t row = first; row < end; ++row) {
      if (next == rows_.size() || rows_[next] != row)
        out_.status.push_back(simulate_one(detector_, in_, row, settings_, seed_, out_));
      else
        write(groups_[next / width], static_cast<int>(next % width), !all_fly, row), ++next;
    }
    return end;
  }

 private:
  static constexpr std::size_t width = lanes_of<T>, most_in_lanes = 32, most_rows = 256;

  // Particles that have flown side by side.
  struct Group {
    std::array<TransportStatus, width> status{};
    std::vector<GapLanes<T>> gaps;
    std::vector<CellLanes<T>> cells;
  };
  // What one of them leaves in a drift gap.
  struct Filled {
    GapCrossing crossing;
    Ionized ionized;
    std::size_t clusters;  // deposits of its own
  };

  std::size_t choose_rows(std::size_t first) {
    rows_.clear();
    std::size_t row = first;
    for (; row < std::min(in_.event.size(), first + most_rows) && rows_.size() < most_in_lanes; ++row) {
      if (for_lanes(detector_, in_, row)) rows_.push_back(row);
    }
    return row;
  }

  ParticleNumber who(std::size_t row) const { return {in_.event[row], in_.particle[row]}; }
  bool ionizes() const { return settings_.fluctuations == Fluctuations::full && !detector_.gaps.empty(); }

  void fly(Group& group, std::vector<CellLanes<T>>& cells, std::size_t first) {
    mask_of<T> used(false);
    typename LaneFlight<T>::Rows rows;
    rows.fill(rows_[first]);
    for (std::size_t i = 0; i < std::min(width, rows_.size() - first); ++i) {
      rows[i] = rows_[first + i];
      set_lane(used, static_cast<int>(i), true);
    }
    group.gaps.clear();
    cells.clear();
    LaneFlight<T> flight(detector_, settings_, in_, rows, used, seed_, group.gaps, cells);
    flight.run();
    each_lane(used, [&](int i) {
      group.status[static_cast<std::size_t>(i)] = flight.status(i);
      for (const GapLanes<T>& gap : group.gaps) {
        if (ionizes() && lane(gap.filled, i)) fill(gap, i, flight.stream(i));
      }
    });
  }

  const GapMatter& matter(const GapLanes<T>& gap) const {
    return detector_.gaps[static_cast<std::size_t>(gap.slab->gap)];
  }

  void fill(const GapLanes<T>& gap, int i, const Stream& stream) {
    const GapCrossing crossing{lane(gap.entry, i), lane(gap.exit, i), detector_.bz, lane(gap.path, i)};
    const std::size_t before = clusters_.size();
    const Ionized ionized = set_free(matter(gap), crossing, lane(gap.inside, i), stream, gap.slab->place,
                                     settings_.deltas, settings_.steps, electrons_, clusters_);
    filled_.push_back({crossing, ionized, clusters_.size() - before});
  }

  void write(const Group& group, int i, bool cells, std::size_t row) {
    for (const GapLanes<T>& gap : group.gaps) {
      if (!lane(gap.filled, i)) continue;
      const GapResult left =
          ionizes() ? write_steps(gap, who(row)) : GapResult{lane(gap.deposit, i) / keV, 0, 0};
      out_.truths.append(who(row), {gap.slab->gap, lane(gap.entry, i), lane(gap.middle, i), lane(gap.exit, i),
                                    lane(gap.inside.p, i), lane(gap.path, i), lane(gap.time, i), left});
    }
    if (cells) append_cells(group.cells, i, who(row), out_.wire_truths);
    out_.status.push_back(group.status[static_cast<std::size_t>(i)]);
  }

  GapResult write_steps(const GapLanes<T>& gap, const ParticleNumber& of) {
    const Filled& filled = filled_[next_filled_++];
    const auto truth = static_cast<std::int64_t>(out_.truths.event.size());
    for (std::size_t k = 0; k < filled.clusters; ++k)
      out_.steps.append(of, gap.slab->gap, clusters_[next_cluster_++], truth);
    of_deltas_.clear();
    const GapResult left = collect(matter(gap), filled.crossing, filled.ionized, electrons_, of_deltas_);
    for (const Deposit& deposit : of_deltas_) out_.steps.append(of, gap.slab->gap, deposit, truth);
    return left;
  }

  const Detector& detector_;
  const ParticleColumns& in_;
  const SimulateSettings& settings_;
  std::uint64_t seed_;
  Simulated& out_;
  std::vector<std::size_t> rows_;  // of those that fly side by side
  std::array<Group, (most_in_lanes + width - 1) / width> groups_;
  DeltaBatch electrons_;
  std::vector<Deposit> clusters_, of_deltas_;  // of the chunk, and of a crossing
  std::vector<Filled> filled_;                 // crossings in the order of their rows
  std::size_t next_filled_ = 0, next_cluster_ = 0;
};

template <class T>
void simulate_lanes(const Detector& detector, const ParticleColumns& particles,
                    const SimulateSettings& settings, std::uint64_t seed, Simulated& out) {
  const bool has_holes =
      std::ranges::any_of(detector.slabs, [](const Slab& s) { return s.holes.pitch != 0; });
  if (has_holes || detector.places.empty()) return simulate(detector, particles, settings, seed, out);
  reserve(detector, settings, particles.event.size(), out);
  SimulatedChunk<T> chunk(detector, particles, settings, seed, out);
  for (std::size_t row = 0; row < particles.event.size();) row = chunk.run(row);
}

}  // namespace cgemit

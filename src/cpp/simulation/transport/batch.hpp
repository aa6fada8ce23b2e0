// Simulates a table of particles, W of them side by side. For each chunk the particles are transported, they
// ionize the gas of the drift gaps, delta electrons are followed, and rows are written in the input's order.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "matter/electron_flight.hpp"
#include "matter/ionization.hpp"
#include "motion/field_ahead.hpp"
#include "motion/uniform.hpp"
#include "simulation/transport/flight.hpp"
#include "simulation/transport/half_turns.hpp"
#include "simulation/transport/simulate.hpp"

namespace cgemit {

// A chunk has enough particles for their delta electrons to fill lanes of their own. The result for a
// particle does not depend on the others. `MotionOf`: motion in the field.
template <class T, template <class> class MotionOf>
class Batch {
 public:
  Batch(const Detector& detector, const ParticleColumns& in, const SimulateSettings& settings,
        std::uint64_t seed, Simulated& out)
      : detector_(detector), in_(in), settings_(settings), seed_(seed), out_(out) {}

  // Simulates the chunk that begins with row `first`. Returns the first row that is left.
  std::size_t run(std::size_t first) {
    const std::size_t end = take_seats(first);
    // Cells that are written at once free the cache for the next group.
    const bool cells_at_once = alone_used_ == 0;
    for (std::size_t g = 0; g < alone_used_; ++g) fly_with_daughters(alone_[g]);
    for (std::size_t g = 0; g * width < side_by_side_; ++g) {
      std::vector<CellRecord<T>>& cells = cells_at_once ? groups_[0].cells : groups_[g].cells;
      fly(groups_[g], cells);
      fly_again(g);
      if (cells_at_once) write_cells_of_group(g, cells);
    }
    ionize();
    ElectronFlight<T>(electrons_).run();
    write(first, end, !cells_at_once);
    return end;
  }

 private:
  static constexpr std::size_t width = lanes_of<T>, most_seats = 256, most_rows = 1024;

  // Particles that are simulated side by side.
  template <class N>
  struct Group {
    typename Flight<N, MotionOf<N>>::Rows rows;
    mask_of<N> used;
    std::array<TransportStatus, lanes_of<N>> status{};
    std::vector<GapRecord<N>> gaps;
    std::vector<CellRecord<N>> cells;
    std::vector<Daughter> daughters;  // of a particle on its own
  };
  // Position of a particle: a lane of a group, or on its own.
  struct Seat {
    std::size_t row;
    bool alone;
    std::size_t group;
    int lane;
  };
  // The result of a particle in a drift gap.
  struct Filled {
    GapCrossing crossing;
    Ionized ionized;
    std::size_t clusters;  // deposits of the particle itself
  };

  // Particles along the beam line leave no hits. Slopes have finite squares, or flight times would be
  // infinite.
  bool flies(std::size_t row) const {
    const double pt2 = in_.px[row] * in_.px[row] + in_.py[row] * in_.py[row];
    return in_.charge[row] != 0 && pt2 > 0 && in_.pz[row] * in_.pz[row] / pt2 < HUGE_VAL;
  }
  // Whether a particle leaves hits before or after its first half turn.
  bool loops(std::size_t row, TransportStatus status) const {
    const bool inward = in_.x[row] * in_.px[row] + in_.y[row] * in_.py[row] < 0;
    return settings_.half_turns > 1 && (inward || status == TransportStatus::curled);
  }
  ParticleNumber who(std::size_t row) const { return {in_.event[row], in_.particle[row]}; }
  bool ionizes() const { return settings_.fluctuations == Fluctuations::full && !detector_.gaps.empty(); }
  template <class N>
  bool ionizes(const GapRecord<N>& gap) const {
    return ionizes() && matter(gap).ionizes();
  }

  std::size_t take_seats(std::size_t first) {
    seats_.clear();
    side_by_side_ = alone_used_ = 0;
    std::size_t row = first;
    for (; row < std::min(in_.event.size(), first + most_rows) && seats_.size() < most_seats; ++row) {
      if (!flies(row)) continue;
      if (width > 1 && in_.mass[row] < 2 * electron_mass) {
        alone_[alone_used_].rows = {row};
        alone_[alone_used_].used = true;
        seats_.push_back({row, true, alone_used_++, 0});
      } else {
        const std::size_t g = side_by_side_ / width, i = side_by_side_++ % width;
        if (i == 0) groups_[g].rows.fill(row);
        if (i == 0) groups_[g].used = mask_of<T>(false);
        groups_[g].rows[i] = row;
        set_lane(groups_[g].used, static_cast<int>(i), true);
        seats_.push_back({row, false, g, static_cast<int>(i)});
      }
    }
    return row;
  }

  template <class N>
  void fly(Group<N>& group, std::vector<CellRecord<N>>& cells) {
    group.gaps.clear();
    cells.clear();
    Flight<N, MotionOf<N>> flight(detector_, settings_, in_, seed_, group.rows, group.used, group.gaps,
                                  cells);
    flight.run();
    each_lane(group.used, [&](int i) { group.status[static_cast<std::size_t>(i)] = flight.status(i); });
  }

  // Particles of a group that decay, or make further half turns, are flown again on their own.
  void fly_again(std::size_t g) {
    for (Seat& seat : seats_) {
      if (seat.alone || seat.group != g) continue;
      const TransportStatus status = groups_[g].status[static_cast<std::size_t>(seat.lane)];
      if (status != TransportStatus::decayed && !loops(seat.row, status)) continue;
      seat = {seat.row, true, alone_used_++, 0};
      alone_[seat.group].rows = {seat.row};
      alone_[seat.group].used = true;
      fly_with_daughters(alone_[seat.group]);
    }
  }

  // Daughters that decay have daughters, too: the list grows.
  void fly_with_daughters(Group<double>& group) {
    group.gaps.clear();
    group.cells.clear();
    group.daughters.clear();
    const std::size_t row = group.rows[0];
    group.status[0] = fly_alone(group, in_, row, 0);
    for (std::size_t k = 0; k < group.daughters.size(); ++k) {
      const Daughter one = group.daughters[k];
      const std::size_t gaps = group.gaps.size(), cells = group.cells.size();
      const auto number = static_cast<std::int32_t>(k + 1);
      group.daughters[k].status = fly_alone(group, columns_of(one), 0, number);
      const auto mark = [&](auto& record) {
        record.daughter = number;
        record.time += one.time;
      };
      std::for_each(group.gaps.begin() + static_cast<std::ptrdiff_t>(gaps), group.gaps.end(), mark);
      std::for_each(group.cells.begin() + static_cast<std::ptrdiff_t>(cells), group.cells.end(), mark);
    }
  }

  // Adds the records of the particle `number` (0: the particle itself), and its daughters.
  TransportStatus fly_alone(Group<double>& group, const ParticleColumns& in, std::size_t row,
                            std::int32_t number) {
    LoopingFlight<MotionOf<double>> flight(detector_, settings_, in, seed_, {row}, group.gaps, group.cells);
    flight.run();
    // The products of a decay that is not drawn are rows of the table.
    if (flight.status(0) == TransportStatus::decayed && !in.decays_at(row)) {
      const double start = number == 0 ? 0.0 : group.daughters[static_cast<std::size_t>(number - 1)].time;
      add_daughters(*settings_.decays->find(in.pdg[row]), flight.decay_point(), stream_of(in, row, seed_),
                    who(group.rows[0]), number, start, group.daughters);
    }
    return flight.status(0);
  }

  template <class F>
  void with_group(const Seat& seat, F&& f) {
    if (seat.alone)
      f(alone_[seat.group]);
    else
      f(groups_[seat.group]);
  }

  // Draws the ionization clusters, and the delta electrons to be followed.
  void ionize() {
    electrons_.clear();
    clusters_.clear();
    filled_.clear();
    if (!ionizes()) return;
    for (const Seat& seat : seats_) {
      with_group(seat, [&](const auto& group) {
        for (const auto& gap : group.gaps) {
          if (!lane(gap.filled, seat.lane) || !ionizes(gap)) continue;
          const auto k = static_cast<std::size_t>(gap.daughter);
          const ParticleColumns in = k == 0 ? in_ : columns_of(group.daughters[k - 1]);
          fill(gap, seat.lane, stream_of_half_turn(in, k == 0 ? seat.row : 0, seed_, gap.half_turn));
        }
      });
    }
  }

  template <class N>
  const GapMatter& matter(const GapRecord<N>& gap) const {
    return detector_.gaps[static_cast<std::size_t>(gap.slab->gap)];
  }

  template <class N>
  void fill(const GapRecord<N>& gap, int i, const Stream& stream) {
    const bool inward = gap.half_turn % 2 != 0;
    const GapCrossing crossing{lane(inward ? gap.exit : gap.entry, i), lane(inward ? gap.entry : gap.exit, i),
                               lane(gap.bz, i), lane(gap.path, i)};
    const std::size_t before = clusters_.size();
    const Ionized ionized = set_free(matter(gap), crossing, lane(gap.inside, i), stream, gap.slab->place,
                                     settings_.deltas, settings_.steps, electrons_, clusters_);
    filled_.push_back({crossing, ionized, clusters_.size() - before});
  }

  void write(std::size_t first, std::size_t end, bool with_cells) {
    next_filled_ = next_cluster_ = 0;
    auto seat = seats_.begin();
    for (std::size_t row = first; row < end; ++row) {
      if (seat == seats_.end() || seat->row != row) {
        out_.status.push_back(in_.charge[row] == 0 ? TransportStatus::neutral : TransportStatus::end);
        continue;
      }
      with_group(*seat, [&](const auto& group) {
        for (const auto& gap : group.gaps)
          if (lane(gap.filled, seat->lane)) write_gap(gap, seat->lane, who(row));
        if (with_cells) write_cells(group.cells, seat->lane, group.rows);
        for (std::size_t k = 0; k < group.daughters.size(); ++k)
          write_daughter(group.daughters[k], static_cast<std::int32_t>(k + 1));
        out_.status.push_back(group.status[static_cast<std::size_t>(seat->lane)]);
      });
      ++seat;
    }
  }

  // While all particles have been side by side: the seats are in the order of the lanes.
  void write_cells_of_group(std::size_t g, const std::vector<CellRecord<T>>& cells) {
    each_lane(groups_[g].used, [&](int i) {
      const Seat& seat = seats_[g * width + static_cast<std::size_t>(i)];
      if (seat.alone)
        write_cells(alone_[seat.group].cells, 0, alone_[seat.group].rows);
      else
        write_cells(cells, i, groups_[g].rows);
    });
  }

  template <class N, class Rows>
  void write_cells(const std::vector<CellRecord<N>>& cells, int i, const Rows& rows) {
    append_cells(cells, i, who(rows[static_cast<std::size_t>(i)]), out_.wire_truths);
  }

  template <class N>
  void write_gap(const GapRecord<N>& gap, int i, const ParticleNumber& of) {
    const GapResult left = ionizes(gap) ? write_steps(gap, of) : GapResult{lane(gap.deposit, i) / keV, 0, 0};
    const HelixPoint entry = lane(gap.entry, i), middle = lane(gap.middle, i), exit = lane(gap.exit, i);
    const double pt = lane(gap.inside.p, i) / std::sqrt(1 + middle.tanl * middle.tanl);
    out_.truths.push_back({.event = of.event,
                           .particle = of.particle,
                           .layer = gap.slab->gap,
                           .entry_x = entry.x,
                           .entry_y = entry.y,
                           .entry_z = entry.z,
                           .exit_x = exit.x,
                           .exit_y = exit.y,
                           .exit_z = exit.z,
                           .r = middle.radius(),
                           .phi = std::atan2(middle.y, middle.x),
                           .z = middle.z,
                           .px = pt * middle.ux,
                           .py = pt * middle.uy,
                           .pz = pt * middle.tanl,
                           .path = lane(gap.path, i),
                           .time = lane(gap.time, i),
                           .energy = left.energy,
                           .secondaries = static_cast<std::uint8_t>(std::min(left.deltas, 255)),
                           .daughter = gap.daughter,
                           .half_turn = gap.half_turn});
  }

  template <class N>
  GapResult write_steps(const GapRecord<N>& gap, const ParticleNumber& of) {
    const Filled& filled = filled_[next_filled_++];
    const auto write = [&](const Deposit& deposit) {
      out_.steps.push_back({.event = of.event,
                            .particle = of.particle,
                            .layer = gap.slab->gap,
                            .x = deposit.x,
                            .y = deposit.y,
                            .z = deposit.z,
                            .dx = deposit.dx,
                            .dy = deposit.dy,
                            .dz = deposit.dz,
                            .energy = deposit.energy,
                            .n_electrons = deposit.electrons,
                            .parent = static_cast<std::int8_t>(deposit.delta > 0 ? 1 : 0),
                            .delta = deposit.delta,
                            .truth = static_cast<std::int64_t>(out_.truths.size())});
    };
    for (std::size_t k = 0; k < filled.clusters; ++k) write(clusters_[next_cluster_++]);
    of_deltas_.clear();
    const GapResult left = collect(matter(gap), filled.crossing, filled.ionized, electrons_, of_deltas_);
    std::ranges::for_each(of_deltas_, write);
    return left;
  }

  void write_daughter(const Daughter& one, std::int32_t number) {
    out_.decays.push_back({.event = one.of.event,
                           .particle = one.of.particle,
                           .daughter = number,
                           .parent = one.parent,
                           .pdg = one.pdg,
                           .mode = one.mode,
                           .x = one.at.position.x,
                           .y = one.at.position.y,
                           .z = one.at.position.z,
                           .time = one.time,
                           .parent_px = one.at.momentum.x,
                           .parent_py = one.at.momentum.y,
                           .parent_pz = one.at.momentum.z,
                           .px = one.momentum.x,
                           .py = one.momentum.y,
                           .pz = one.momentum.z,
                           .status = one.status});
  }

  const Detector& detector_;
  const ParticleColumns& in_;
  const SimulateSettings& settings_;
  std::uint64_t seed_;
  Simulated& out_;
  std::vector<Seat> seats_;  // in the order of the rows
  std::array<Group<T>, (most_seats + width - 1) / width> groups_;
  std::array<Group<double>, most_seats> alone_;
  std::size_t side_by_side_ = 0, alone_used_ = 0;
  DeltaBatch electrons_;
  std::vector<Deposit> clusters_, of_deltas_;  // of the chunk, and of a crossing
  std::vector<Filled> filled_;                 // crossings in the order of their rows
  std::size_t next_filled_ = 0, next_cluster_ = 0;
};

template <class T, template <class> class MotionOf>
void simulate_in(const Detector& detector, const ParticleColumns& particles, const SimulateSettings& settings,
                 std::uint64_t seed, Simulated& out) {
  Batch<T, MotionOf> batch(detector, particles, settings, seed, out);
  for (std::size_t row = 0; row < particles.event.size() && !settings.interrupted();) row = batch.run(row);
}

// Reserves memory for this many particles.
inline void reserve(const Detector& detector, const SimulateSettings& settings, std::size_t n,
                    Simulated& out) {
  out.status.reserve(n);
  out.truths.reserve(n * detector.layers.size());
  if (settings.deltas && settings.fluctuations == Fluctuations::full) out.steps.reserve(10 * n);
  // Tracks cross slightly more than one cell of a layer.
  out.wire_truths.reserve(n * (detector.wires.size() + detector.wires.size() / 8));
}

template <class T>
void simulate_lanes(const Detector& detector, const ParticleColumns& particles,
                    const SimulateSettings& settings, std::uint64_t seed, Simulated& out) {
  reserve(detector, settings, particles.event.size(), out);
  if (detector.field.is_uniform())
    return simulate_in<T, UniformMotionOf>(detector, particles, settings, seed, out);
  simulate_in<T, FieldAheadOf>(detector, particles, settings, seed, out);
}

}  // namespace cgemit

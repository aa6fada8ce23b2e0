// Simulation of charged particles: from the vertex outward through matter, drift gaps and drift cells.
#pragma once

#include <cmath>
#include <cstdint>
#include <span>
#include <vector>

#include "common/interrupt.hpp"
#include "common/rng.hpp"
#include "common/status.hpp"
#include "detector/detector.hpp"
#include "simulation/transport/decays.hpp"
#include "simulation/transport/rows.hpp"

namespace cgemit {

enum class Fluctuations { full, gaussian, off };

inline constexpr int most_half_turns = 15;  // the readout knows 16 crossings of a layer apart

struct SimulateSettings {
  Fluctuations fluctuations;
  bool deltas;               // electrons that leave the particle's track
  bool steps;                // also the particle's own ionization clusters
  const DecayTable* decays;  // null: nothing decays
  int half_turns;            // most of a particle: from perigee to apex, or back; 1 to most_half_turns
  Interrupted interrupted;
};

// One row per generated particle; all columns of one length.
struct ParticleColumns {
  std::span<const std::int64_t> event;
  std::span<const std::int32_t> particle, pdg;
  std::span<const std::int8_t> charge;
  std::span<const double> mass, x, y, z, px, py, pz;
  // ns since the start, of decays that are not drawn; infinite: a particle has none. Empty: no particle has.
  std::span<const double> decay_time{};

  bool decays_at(std::size_t row) const { return !decay_time.empty() && decay_time[row] < HUGE_VAL; }

  static constexpr auto columns() {
    return std::tuple(Column("event", &ParticleColumns::event),
                      Column("particle", &ParticleColumns::particle), Column("pdg", &ParticleColumns::pdg),
                      Column("charge", &ParticleColumns::charge), Column("mass", &ParticleColumns::mass),
                      Column("x", &ParticleColumns::x), Column("y", &ParticleColumns::y),
                      Column("z", &ParticleColumns::z), Column("px", &ParticleColumns::px),
                      Column("py", &ParticleColumns::py), Column("pz", &ParticleColumns::pz));
  }
  static constexpr auto optional() { return std::tuple(Column("decay_time", &ParticleColumns::decay_time)); }
};

struct Simulated {
  Columns<TruthRow> truths;
  Columns<StepRow> steps;
  Columns<WireTruthRow> wire_truths;
  Columns<DecayRow> decays;
  std::vector<TransportStatus> status;  // one per particle
};

// Appends to `out`. With one half turn, hits are recorded on the outward path only; a particle that starts
// inward first crosses the matter there.
void simulate(const Detector& detector, const ParticleColumns& particles, const SimulateSettings& settings,
              std::uint64_t seed, Simulated& out);

}  // namespace cgemit

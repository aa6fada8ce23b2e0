// Simulation of charged particles: from the vertex outward through matter, drift gaps and drift cells.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "common/rng.hpp"
#include "common/status.hpp"
#include "detector/detector.hpp"

namespace cgemit {

enum class Fluctuations { full, gaussian, off };

struct SimulateSettings {
  Fluctuations fluctuations;
  bool deltas;  // electrons that leave the track's way
  bool steps;   // also the particle's own ionization clusters
};

// One row per generated particle; all columns of one length.
struct ParticleColumns {
  std::span<const std::int64_t> event;
  std::span<const std::int32_t> particle;
  std::span<const std::int8_t> charge;
  std::span<const double> mass, x, y, z, px, py, pz;
};

// One row per crossing of a drift gap.
struct Truths {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> particle, layer;
  std::vector<double> entry_x, entry_y, entry_z, exit_x, exit_y, exit_z;  // mm
  std::vector<double> r, phi, z;                                          // middle of the gap
  std::vector<double> px, py, pz;                                         // GeV/c, there
  std::vector<double> path, time, energy;                                 // mm, ns, keV
  std::vector<std::uint8_t> secondaries;
};

// One row per deposit in a drift gap: a piece of a delta electron's way, or an ionization cluster.
struct Steps {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> particle, layer;
  std::vector<double> x, y, z, dx, dy, dz;  // mm, middle, and end minus begin
  std::vector<double> energy;               // keV
  std::vector<std::int32_t> electrons;
  std::vector<std::int8_t> parent;  // 0 the particle, 1 a delta electron
  std::vector<std::int32_t> delta;  // number of the delta electron in the crossing, from 1
  std::vector<std::int64_t> truth;  // row of the crossing
};

// One row per drift cell that a particle passes.
struct WireTruths {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> particle, layer, wire;
  std::vector<double> doca;  // mm, signed
  std::vector<std::int8_t> side;
  std::vector<double> x, y, z, time;  // closest point on the track
};

struct Simulated {
  Truths truths;
  Steps steps;
  WireTruths wire_truths;
  std::vector<TransportStatus> status;  // one per particle
};

// Hits are recorded on the way out; a particle that first moves inward only meets the matter there.
Simulated simulate(const Detector& detector, const ParticleColumns& particles,
                   const SimulateSettings& settings, std::uint64_t seed);

}  // namespace cgemit

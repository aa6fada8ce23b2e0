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
  WireTruths wire_truths;
  std::vector<TransportStatus> status;  // one per particle
};

// Hits are recorded on the way out; a particle that first moves inward only meets the matter there.
Simulated simulate(const Detector& detector, const ParticleColumns& particles,
                   const SimulateSettings& settings, std::uint64_t seed);

}  // namespace cgemit

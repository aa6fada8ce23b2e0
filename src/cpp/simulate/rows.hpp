// The tables that the simulation writes, one vector a column.
#pragma once

#include <cstdint>
#include <vector>

#include "matter/ionization.hpp"
#include "motion/helix.hpp"

namespace cgemit {

struct ParticleNumber {
  std::int64_t event;
  std::int32_t particle;
};

// A crossing of a drift gap.
struct GapRow {
  std::int32_t layer;
  HelixPoint entry, middle, exit;
  double momentum;    // GeV/c
  double path, time;  // mm, ns
  GapResult left;
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

  void reserve(std::size_t n);
  void append(const ParticleNumber& who, const GapRow& row);
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

  void reserve(std::size_t n);
  void append(const ParticleNumber& who, std::int32_t in_layer, const Deposit& deposit,
              std::int64_t in_truth);
};

// One row per drift cell that a particle passes.
struct WireTruths {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> particle, layer, wire;
  std::vector<double> doca;  // mm, signed
  std::vector<std::int8_t> side;
  std::vector<double> x, y, z, time;  // closest point on the track

  void reserve(std::size_t n);
  void resize(std::size_t n);
};

}  // namespace cgemit

// The tables written by the simulation, one vector per column. `each_column` calls a function with the name
// and the values of every column.
#pragma once

#include <cstdint>
#include <vector>

#include "common/status.hpp"
#include "matter/ionization.hpp"
#include "motion/helix.hpp"
#include "simulation/transport/daughters.hpp"

namespace cgemit {

// A crossing of a drift gap.
struct GapRow {
  std::int32_t layer, daughter;
  std::int8_t half_turn;
  HelixPoint entry, middle, exit;
  double momentum;    // GeV/c
  double path, time;  // mm, ns
  GapResult left;
};

// One row per crossing of a drift gap.
struct Truths {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> particle, layer, daughter;
  std::vector<double> entry_x, entry_y, entry_z, exit_x, exit_y, exit_z;  // mm
  std::vector<double> r, phi, z;                                          // middle of the gap
  std::vector<double> px, py, pz;                                         // GeV/c, there
  std::vector<double> path, time, energy;                                 // mm, ns, keV
  std::vector<std::uint8_t> secondaries;
  std::vector<std::int8_t> half_turn;

  void append(const ParticleNumber& who, const GapRow& row);
  template <class F>
  void each_column(F&& f) {
    f("event", event), f("particle", particle), f("layer", layer);
    f("entry_x", entry_x), f("entry_y", entry_y), f("entry_z", entry_z);
    f("exit_x", exit_x), f("exit_y", exit_y), f("exit_z", exit_z);
    f("r", r), f("phi", phi), f("z", z), f("px", px), f("py", py), f("pz", pz);
    f("path", path), f("time", time), f("energy", energy), f("secondaries", secondaries);
    f("daughter", daughter), f("half_turn", half_turn);
  }
};

// One row per deposit in a drift gap: a piece of a delta electron's path, or an ionization cluster.
struct Steps {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> particle, layer;
  std::vector<double> x, y, z, dx, dy, dz;  // mm, middle, and end minus begin
  std::vector<double> energy;               // keV
  std::vector<std::int32_t> electrons;
  std::vector<std::int8_t> parent;  // 0: the particle, 1: a delta electron
  std::vector<std::int32_t> delta;  // number of the delta electron in the crossing, from 1
  std::vector<std::int64_t> truth;  // row of the crossing

  void append(const ParticleNumber& who, std::int32_t in_layer, const Deposit& deposit,
              std::int64_t in_truth);
  template <class F>
  void each_column(F&& f) {
    f("event", event), f("particle", particle), f("layer", layer);
    f("x", x), f("y", y), f("z", z), f("dx", dx), f("dy", dy), f("dz", dz), f("energy", energy);
    f("n_electrons", electrons), f("parent", parent), f("delta", delta), f("truth", truth);
  }
};

// One row per drift cell that a particle crosses.
struct WireTruths {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> particle, layer, wire, daughter;
  std::vector<double> doca;  // mm, signed
  std::vector<std::int8_t> side, half_turn;
  std::vector<double> x, y, z, time;  // closest point on the track

  template <class F>
  void each_column(F&& f) {
    f("event", event), f("particle", particle), f("layer", layer), f("wire", wire), f("doca", doca);
    f("side", side), f("x", x), f("y", y), f("z", z), f("time", time), f("daughter", daughter);
    f("half_turn", half_turn);
  }
};

// One row per charged daughter of a decay.
struct Decays {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> particle, daughter, parent, pdg, mode;
  std::vector<double> x, y, z, time;                    // mm, ns
  std::vector<double> parent_px, parent_py, parent_pz;  // GeV/c, at the decay
  std::vector<double> px, py, pz;                       // GeV/c, of the daughter
  std::vector<std::int8_t> status;

  void append(const Daughter& one, std::int32_t number);
  template <class F>
  void each_column(F&& f) {
    f("event", event), f("particle", particle), f("daughter", daughter), f("parent", parent), f("pdg", pdg);
    f("mode", mode), f("x", x), f("y", y), f("z", z), f("time", time), f("parent_px", parent_px);
    f("parent_py", parent_py), f("parent_pz", parent_pz), f("px", px), f("py", py), f("pz", pz);
    f("status", status);
  }
};

template <class Table>
void reserve_rows(Table& table, std::size_t n) {
  table.each_column([n](const char*, auto& column) { column.reserve(n); });
}
template <class Table>
void resize_rows(Table& table, std::size_t n) {
  table.each_column([n](const char*, auto& column) { column.resize(n); });
}

}  // namespace cgemit

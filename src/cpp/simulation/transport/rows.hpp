// Rows of the tables written by the simulation.
#pragma once

#include <cstdint>
#include <tuple>

#include "common/columns.hpp"
#include "common/status.hpp"

namespace cgemit {

// A crossing of a drift gap.
struct TruthRow {
  std::int64_t event;
  std::int32_t particle, layer;
  double entry_x, entry_y, entry_z, exit_x, exit_y, exit_z;  // mm
  double r, phi, z;                                          // middle of the gap
  double px, py, pz;                                         // GeV/c, there
  double path, time, energy;                                 // mm, ns, keV
  std::uint8_t secondaries;
  std::int32_t daughter;
  std::int8_t half_turn;

  static constexpr auto columns() {
    using R = TruthRow;
    return std::tuple(
        Column("event", &R::event), Column("particle", &R::particle), Column("layer", &R::layer),
        Column("entry_x", &R::entry_x), Column("entry_y", &R::entry_y), Column("entry_z", &R::entry_z),
        Column("exit_x", &R::exit_x), Column("exit_y", &R::exit_y), Column("exit_z", &R::exit_z),
        Column("r", &R::r), Column("phi", &R::phi), Column("z", &R::z), Column("px", &R::px),
        Column("py", &R::py), Column("pz", &R::pz), Column("path", &R::path), Column("time", &R::time),
        Column("energy", &R::energy), Column("secondaries", &R::secondaries),
        Column("daughter", &R::daughter), Column("half_turn", &R::half_turn));
  }
};

// A deposit in a drift gap: a piece of a delta electron's path, or an ionization cluster.
struct StepRow {
  std::int64_t event;
  std::int32_t particle, layer;
  double x, y, z, dx, dy, dz;  // mm, middle, and end minus begin
  double energy;               // keV
  std::int32_t n_electrons;
  std::int8_t parent;  // 0: the particle, 1: a delta electron
  std::int32_t delta;  // number of the delta electron in the crossing, from 1
  std::int64_t truth;  // row of the crossing

  static constexpr auto columns() {
    using R = StepRow;
    return std::tuple(Column("event", &R::event), Column("particle", &R::particle),
                      Column("layer", &R::layer), Column("x", &R::x), Column("y", &R::y), Column("z", &R::z),
                      Column("dx", &R::dx), Column("dy", &R::dy), Column("dz", &R::dz),
                      Column("energy", &R::energy), Column("n_electrons", &R::n_electrons),
                      Column("parent", &R::parent), Column("delta", &R::delta), Column("truth", &R::truth));
  }
};

// A drift cell that a particle crosses.
struct WireTruthRow {
  std::int64_t event;
  std::int32_t particle, layer, wire;
  double doca;  // mm, signed
  std::int8_t side;
  double x, y, z, time;  // closest point on the track
  std::int32_t daughter;
  std::int8_t half_turn;

  static constexpr auto columns() {
    using R = WireTruthRow;
    return std::tuple(Column("event", &R::event), Column("particle", &R::particle),
                      Column("layer", &R::layer), Column("wire", &R::wire), Column("doca", &R::doca),
                      Column("side", &R::side), Column("x", &R::x), Column("y", &R::y), Column("z", &R::z),
                      Column("time", &R::time), Column("daughter", &R::daughter),
                      Column("half_turn", &R::half_turn));
  }
};

// A charged daughter of a decay.
struct DecayRow {
  std::int64_t event;
  std::int32_t particle, daughter, parent, pdg, mode;
  double x, y, z, time;                    // mm, ns
  double parent_px, parent_py, parent_pz;  // GeV/c, at the decay
  double px, py, pz;                       // GeV/c, of the daughter
  TransportStatus status;

  static constexpr auto columns() {
    using R = DecayRow;
    return std::tuple(
        Column("event", &R::event), Column("particle", &R::particle), Column("daughter", &R::daughter),
        Column("parent", &R::parent), Column("pdg", &R::pdg), Column("mode", &R::mode), Column("x", &R::x),
        Column("y", &R::y), Column("z", &R::z), Column("time", &R::time), Column("parent_px", &R::parent_px),
        Column("parent_py", &R::parent_py), Column("parent_pz", &R::parent_pz), Column("px", &R::px),
        Column("py", &R::py), Column("pz", &R::pz), Column("status", &R::status));
  }
};

}  // namespace cgemit

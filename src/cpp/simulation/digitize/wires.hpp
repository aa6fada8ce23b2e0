// Readout of the drift chamber: measured drift distances of the cells that tracks cross.
#pragma once

#include <cstdint>
#include <span>
#include <tuple>

#include "common/columns.hpp"
#include "detector/detector.hpp"

namespace cgemit {

struct WireTruthColumns {
  std::span<const std::int64_t> event;
  std::span<const std::int32_t> particle;
  std::span<const std::int32_t> layer, wire;  // layer: the experiment's number
  std::span<const double> doca;               // mm, signed
  std::span<const std::int8_t> side;          // +1 or -1
  std::span<const double> delay;              // ns, by which the signal is later than the drift

  std::size_t size() const { return event.size(); }

  static constexpr auto columns() {
    return std::tuple(Column("event", &WireTruthColumns::event),
                      Column("particle", &WireTruthColumns::particle),
                      Column("layer", &WireTruthColumns::layer), Column("wire", &WireTruthColumns::wire),
                      Column("doca", &WireTruthColumns::doca), Column("side", &WireTruthColumns::side),
                      Column("delay", &WireTruthColumns::delay));
  }
};

struct WireReadout {
  bool reveal_sides;
  std::uint64_t seed;
};

// A fired cell.
struct WireHitRow {
  std::int64_t event;
  std::int32_t layer, wire, gid;
  double drift, sigma;      // mm
  double drift_time;        // ns
  std::int8_t side;         // 0 hidden
  std::int64_t wire_truth;  // row of the cell crossing that gave the hit

  static constexpr auto columns() {
    return std::tuple(Column("event", &WireHitRow::event), Column("layer", &WireHitRow::layer),
                      Column("wire", &WireHitRow::wire), Column("gid", &WireHitRow::gid),
                      Column("drift", &WireHitRow::drift), Column("sigma", &WireHitRow::sigma),
                      Column("drift_time", &WireHitRow::drift_time), Column("side", &WireHitRow::side),
                      Column("wire_truth", &WireHitRow::wire_truth));
  }
};

// Error, efficiency, and the relation of distance and time are those of the wire layer.
// The drift distance is |doca| plus a Gaussian error sigma(|doca|), not cut at zero. Near the wire it may be
// slightly negative; side times drift is then exactly Gaussian about doca. A cell fired by several particles
// gives one hit, that with the smallest sum of delay and drift time; the drift time of the hit is without
// delay. Rows are ordered by event, layer, wire.
Columns<WireHitRow> read_out_wires(const Detector& detector, const WireTruthColumns& truths,
                                   const WireReadout& readout);

}  // namespace cgemit

// Rows of the digis table.
#pragma once

#include <cstdint>
#include <limits>
#include <tuple>

#include "common/columns.hpp"
#include "common/units.hpp"

namespace cgemit {

struct DigiRow {
  std::int64_t event;
  std::int32_t layer, sheet;
  std::int8_t view;                                            // 0 X, 1 V
  std::int32_t strip = -1, gid = -1;                           // -1: the digi has a position instead
  double position = std::numeric_limits<double>::quiet_NaN();  // mm, X or V; NaN: the digi has a strip
  double charge = 0;                                           // fC
  double time = 0;                                             // ns, of the earliest contribution
  std::int64_t truth = -1;                                     // row of the largest contribution
  std::int32_t n_truths = 0;

  static constexpr auto columns() {
    return std::tuple(Column("event", &DigiRow::event), Column("layer", &DigiRow::layer),
                      Column("sheet", &DigiRow::sheet), Column("view", &DigiRow::view),
                      Column("strip", &DigiRow::strip), Column("gid", &DigiRow::gid),
                      Column("position", &DigiRow::position), Column("charge", &DigiRow::charge),
                      Column("time", &DigiRow::time), Column("truth", &DigiRow::truth),
                      Column("n_truths", &DigiRow::n_truths));
  }
};

// fC on the anode per keV of deposited energy. `gain`: electrons on the anode per electron of ionization;
// `w_value`: keV per electron of ionization.
inline double charge_per_energy(double gain, double w_value) { return gain / w_value * elementary_charge_fC; }

}  // namespace cgemit

// Rows of the digis table.
#pragma once

#include <cstdint>
#include <limits>
#include <vector>

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
};

// One vector per column.
struct DigiColumns {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> layer, sheet;
  std::vector<std::int8_t> view;
  std::vector<std::int32_t> strip, gid;
  std::vector<double> position, charge, time;
  std::vector<std::int64_t> truth;
  std::vector<std::int32_t> n_truths;

  void push_back(const DigiRow& row) {
    event.push_back(row.event);
    layer.push_back(row.layer);
    sheet.push_back(row.sheet);
    view.push_back(row.view);
    strip.push_back(row.strip);
    gid.push_back(row.gid);
    position.push_back(row.position);
    charge.push_back(row.charge);
    time.push_back(row.time);
    truth.push_back(row.truth);
    n_truths.push_back(row.n_truths);
  }
};

// fC on the anode per keV of deposited energy. `gain`: electrons on the anode per electron of ionization;
// `w_value`: keV per electron of ionization.
inline double charge_per_energy(double gain, double w_value) { return gain / w_value * elementary_charge_fC; }

}  // namespace cgemit

// Readout without strips: positions at mid-gap, smeared with given errors. With it all later stages have an
// exact expectation.
#pragma once

#include <cstdint>
#include <span>
#include <tuple>

#include "common/columns.hpp"
#include "detector/detector.hpp"
#include "simulation/digitize/digis.hpp"
#include "simulation/digitize/truths.hpp"

namespace cgemit {

// How one layer measures positions.
struct PositionErrors {
  double sigma_x, sigma_v;  // mm, of X = r_readout dphi and of V; 0: the middle of a strip
  double sigma_time;        // ns

  static constexpr auto columns() {
    return std::tuple(Column("sigma_x", &PositionErrors::sigma_x),
                      Column("sigma_v", &PositionErrors::sigma_v),
                      Column("sigma_time", &PositionErrors::sigma_time));
  }
};

struct GaussianReadout {
  std::span<const PositionErrors> errors;  // of each layer
  double gain;                             // electrons on the anode per electron of ionization
  std::span<const double> w_values;        // keV per electron of ionization, of each layer
  std::uint64_t seed;
};

// A position in each view of the layer for each truth on the active area of a sheet, ordered by event, layer,
// sheet, view, and then as the truths. X and V errors are independent.
Columns<DigiRow> smear_positions(const Detector& detector, const TruthColumns& truths,
                                 const GaussianReadout& readout);

}  // namespace cgemit

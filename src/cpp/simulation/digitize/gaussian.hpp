// Readout without strips: positions at mid-gap, smeared with given errors. With it all later stages have an
// exact expectation.
#pragma once

#include <cstdint>
#include <span>

#include "common/columns.hpp"
#include "detector/detector.hpp"
#include "readout/position_errors.hpp"
#include "simulation/digitize/digis.hpp"
#include "simulation/digitize/truths.hpp"

namespace cgemit {

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

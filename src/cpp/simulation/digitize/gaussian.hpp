// Read-out without strips: positions at mid-gap, smeared with given errors. With it all later stages have an
// exact expectation.
#pragma once

#include <cstdint>
#include <span>

#include "detector/detector.hpp"
#include "simulation/digitize/digis.hpp"
#include "simulation/digitize/truths.hpp"

namespace cgemit {

struct GaussianReadout {
  double sigma_x;                    // mm, of X = r_readout dphi
  double sigma_v;                    // mm
  double gain;                       // electrons on the anode per electron of ionization
  std::span<const double> w_values;  // keV per electron of ionization, of each CGEM layer
  std::uint64_t seed;
};

// An X and a V position for each truth on the active area of a sheet, ordered by event, layer, sheet, view,
// and then as the truths. X and V errors are independent.
DigiColumns smear_positions(const Detector& detector, const TruthColumns& truths,
                            const GaussianReadout& readout);

}  // namespace cgemit

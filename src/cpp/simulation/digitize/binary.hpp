// Binary readout of the CGEM layers (arXiv:1504.02570): makes fired strips of truths.
#pragma once

#include <span>

#include "detector/detector.hpp"
#include "readout/strip_maps.hpp"
#include "simulation/digitize/digis.hpp"
#include "simulation/digitize/truths.hpp"

namespace cgemit {

struct BinaryReadout {
  double gain;                       // electrons on the anode per electron of ionization
  std::span<const double> w_values;  // keV per electron of ionization, of each CGEM layer
  double threshold;                  // fC, on the total charge of a truth
};

// One row per fired strip, ordered by event, layer, sheet, view, strip.
//
// No Lorentz angle but the layer's own shift, no diffusion, no drift time. X and V view collect half of the
// charge each. Every step of a delta electron shares its charge equally among the strips of a view that its
// own projection touches. The rest of the truth's energy belongs to the particle and is shared by the strips
// between entry and exit. Steps of the particle itself have no effect. `gains` act where the truth crosses
// the middle of the gap.
Columns<DigiRow> read_out_strips(const Detector& detector, const TruthColumns& truths,
                                 const StepColumns& steps, const BinaryReadout& readout,
                                 const GainMaps& gains = {});

}  // namespace cgemit

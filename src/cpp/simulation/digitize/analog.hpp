// Analog readout of the CGEM layers: electrons of ionization drift, multiply and induce currents on the
// strips, which a chip turns into charges and times (docs/methods/readout.md).
#pragma once

#include <cstdint>
#include <span>

#include "common/interrupt.hpp"
#include "detector/detector.hpp"
#include "readout/chips.hpp"
#include "readout/strip_maps.hpp"
#include "simulation/digitize/avalanche.hpp"
#include "simulation/digitize/digis.hpp"
#include "simulation/digitize/strip_signals.hpp"
#include "simulation/digitize/truths.hpp"

namespace cgemit {

struct AnalogModel {
  std::span<const LayerDrift> drift;  // of each CGEM layer
  ElectronPhysics physics;
  Chip chip;
  double share_spread;  // standard deviation of ln(charge on X / charge on V) from crossing to crossing
  InducedCharge induced;
  std::uint64_t seed;
  Interrupted interrupted = never_interrupted;
};

// One row per strip above threshold, ordered by event, layer, sheet, view, strip. Every truth needs all its
// deposits as steps, ionization clusters included: throws std::invalid_argument naming the first one that
// lacks some. `gains` act where an avalanche reaches the anode. One electron at a time: the reference of the
// kernels (kernels/kernels.hpp), which have several side by side.
void read_out_analog(const Detector& detector, const TruthColumns& truths, const StepColumns& steps,
                     const AnalogModel& readout, const GainMaps& gains, Columns<DigiRow>& digis);

}  // namespace cgemit

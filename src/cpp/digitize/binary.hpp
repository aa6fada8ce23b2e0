// Binary read-out of the CGEM layers (arXiv:1504.02570): truths become fired strips.
#pragma once

#include <cstdint>
#include <vector>

#include "detector/detector.hpp"
#include "digitize/truths.hpp"

namespace cgemit {

struct BinaryReadout {
  double gain;       // electrons on the anode per electron of ionization
  double w_value;    // keV per electron of ionization
  double threshold;  // fC, on the total charge of a truth
};

// One row per fired strip, ordered by event, layer, sheet, view, strip.
struct DigiColumns {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> layer, sheet;
  std::vector<std::int8_t> view;  // 0 X, 1 V
  std::vector<std::int32_t> strip, gid;
  std::vector<double> charge;       // fC
  std::vector<double> time;         // ns, of the earliest contribution
  std::vector<std::int64_t> truth;  // row of the largest contribution
  std::vector<std::int32_t> n_truths;
};

// No Lorentz angle, no diffusion, no drift time. X and V view collect half of the charge each. Every step of
// a delta electron shares its charge equally among the strips of a view that its own projection touches; what
// is left of the truth's energy is the particle's and shared by the strips between entry and exit. Steps of
// the particle itself change nothing.
DigiColumns read_out_strips(const Detector& detector, const TruthColumns& truths, const StepColumns& steps,
                            const BinaryReadout& readout);

}  // namespace cgemit

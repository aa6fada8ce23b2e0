#include "common/lanes/number.hpp"
#include "simulation/digitize/analog_batch.hpp"

namespace cgemit {

void read_out_analog(const Detector& detector, const TruthColumns& truths, const StepColumns& steps,
                     const AnalogModel& readout, const GainMaps& gains, Columns<DigiRow>& digis) {
  read_out_analog_lanes<Number>(detector, truths, steps, readout, gains, digis);
}

}  // namespace cgemit

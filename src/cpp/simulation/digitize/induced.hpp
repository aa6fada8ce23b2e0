// Charge that strips with much charge induce on their neighbours, by capacity.
#pragma once

#include <array>
#include <cstdint>

#include "detector/detector.hpp"
#include "simulation/digitize/digis.hpp"

namespace cgemit {

struct InducedCharge {
  std::array<double, 2> threshold;  // fC, of X and V strips
  double saturation;                // fC, largest charge
  std::uint64_t seed;
};

// What a strip with a charge (fC) does to each of its neighbours: functions of PARSIFAL for triple GEMs with
// APV25 chips, in ADC counts of 1/30 fC there.
double induced_probability(double charge);
double induced_share(double charge);  // of the charge
double induced_delay(double charge);  // ns, mean; negative

// Adds the induced charges to digis ordered by event, layer, sheet, view and strip. A strip that has a time
// keeps it; one that has only induced charge above threshold has a digi with the time of the largest part.
DigiColumns with_induced(const Detector& detector, const DigiColumns& digis, const InducedCharge& model);

}  // namespace cgemit

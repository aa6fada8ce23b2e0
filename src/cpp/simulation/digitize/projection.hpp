// Analog readout without drift physics, the second model of arXiv:1504.02570: the projected path is a charge
// profile of given width, integrated over each strip.
#pragma once

#include <cstdint>
#include <span>

#include "detector/detector.hpp"
#include "readout/strip_maps.hpp"
#include "simulation/digitize/digis.hpp"
#include "simulation/digitize/truths.hpp"

namespace cgemit {

struct ProjectionReadout {
  double gain;                       // electrons on the anode per electron of ionization
  std::span<const double> w_values;  // keV per electron of ionization, of each CGEM layer
  double sigma;                      // mm, width of the profile across the path
  double threshold;                  // fC, of a strip
  double noise;                      // fC, of a strip
  std::uint64_t seed;
};

// Part up to `edge` of a charge that is uniform from `a` to `b` and smeared by a Gaussian.
double profile_below(double edge, double a, double b, double sigma);

// One row per strip above threshold, ordered by event, layer, sheet, view, strip. Steps count as in
// `read_out_strips`. `gains` act in the middle of each step and where a truth crosses the middle of the gap.
Columns<DigiRow> read_out_profiles(const Detector& detector, const TruthColumns& truths,
                                   const StepColumns& steps, const ProjectionReadout& readout,
                                   const GainMaps& gains = {});

}  // namespace cgemit

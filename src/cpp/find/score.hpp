// Terms of the score of a track, logarithms of likelihood ratios.
#pragma once

#include <cmath>

#include "common/units.hpp"

namespace cgemit {

inline constexpr double most_prompt = 7;  // about the largest `log_prompt`

inline double log_gaussian(double chi2, double variance) {
  return -0.5 * (chi2 + std::log(2 * pi * variance));
}

// Most tracks come from the beam line, while chance has no such preference: it spreads d up to `max_d`.
inline double log_prompt(double d, double variance, double max_d) {
  constexpr double prompt = 0.9, beam = 0.5;  // share of the tracks; mm
  const double total = variance + beam * beam;
  return std::log(prompt * std::exp(log_gaussian(d * d / total, total)) * 2 * max_d + 1 - prompt);
}

}  // namespace cgemit

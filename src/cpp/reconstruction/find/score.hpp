// Terms of the score of a track, logarithms of likelihood ratios.
#pragma once

#include <cmath>

#include "common/units.hpp"
#include "kalman/filter.hpp"
#include "reconstruction/find/find.hpp"

namespace cgemit {

inline constexpr double hopeless = 0;     // score: chance explains the hits as well
inline constexpr double most_prompt = 8;  // about the largest `log_prompt`

inline double log_gaussian(double chi2, double variance) {
  return -0.5 * (chi2 + std::log(2 * pi * variance));
}

// rad2, of the scatter in one layer, with the slope 1/cos(theta)^2 of the track (Highland, without the
// logarithm).
inline double scatter_in_layer(const FindSettings& settings, double pt, double slope) {
  constexpr double thickness = 0.008,
                   highland = 13.6 * MeV;  // radiation lengths of a layer; of the beam pipe, too
  const double p2 = pt * pt * slope;
  return square(settings.charge * highland) * thickness * std::sqrt(slope) *
         (p2 + settings.mass * settings.mass) / (p2 * p2);
}

// Most tracks come from the beams' crossing, while chance has no such preference: it spreads d up to `max_d`
// and z0 up to `max_z`.
inline double log_prompt(const Perigee& helix, const Symmetric<double>& covariance, double max_d,
                         double max_z) {
  constexpr double prompt = 0.9, beam = 0.5, along = 30;  // share of the tracks; mm
  const double d = covariance(0, 0) + beam * beam, z = covariance(3, 3) + along * along;
  const double near = log_gaussian(helix.d * helix.d / d, d) + log_gaussian(helix.z0 * helix.z0 / z, z);
  return std::log(prompt * std::exp(near) * 4 * max_d * max_z + 1 - prompt);
}

}  // namespace cgemit

#include "reconstruction/find/segment_score.hpp"

#include <algorithm>

#include "common/units.hpp"
#include "motion/helix.hpp"
#include "reconstruction/find/score.hpp"

namespace cgemit {

namespace {

constexpr double least_error = 0.3;  // mm, of a height
// Of the residuals: delta electrons and noise move clusters.
constexpr double tail = 0.1, tail_width = 4;
// Particles are spread over all azimuths, and about so far in the others.
constexpr double farthest = 4, usual_error = 1.5;  // standard deviations; mm
constexpr double spread_tanl = 1;
constexpr double prompt_share = 0.9, beam = 0.5, along = 30;  // of the tracks; mm

double log_sum(double a, double b) { return std::max(a, b) + std::log1p(std::exp(-std::abs(a - b))); }

// Gaussian with tails.
double log_residual(double off, double variance) {
  static const double core = std::log1p(-tail), far = std::log(tail / tail_width);
  constexpr double wide = tail_width * tail_width;
  const double chi2 = off * off / variance;
  return log_gaussian(0, variance) + log_sum(core - 0.5 * chi2, far - 0.5 * chi2 / wide);
}

}  // namespace

SegmentScore::SegmentScore(const Detector& detector, const FindSettings& settings)
    : detector_(detector),
      settings_(settings),
      log_found_(std::log(settings.efficiency)),
      log_missed_(std::log1p(-settings.efficiency)),
      log_prompt_(std::log(prompt_share) - 0.5 * std::log(2 * pi * along * along)),
      log_elsewhere_(std::log((1 - prompt_share) / (4 * settings.max_d * settings.max_z))),
      gain_(detector.layers.size()) {}

void SegmentScore::start(const EventHits& hits) {
  hits_ = &hits;
  for (std::size_t i = 0; i < gain_.size(); ++i) {
    gain_[i][0] = log_found_ - std::log(hits.density(i, View::x));
    // Densities are of V, lines are in z.
    gain_[i][1] = log_found_ - std::log(hits.density(i, View::v) * std::abs(detector_.layers[i].sin_stereo));
  }
}

void SegmentScore::circle(const std::array<std::size_t, 3>& layers, const std::array<std::int32_t, 3>& x,
                          const Three& s, double d, double kappa) {
  layers_ = layers;
  x_ = x;
  s_ = s;
  d_ = d;
  pt_ = pt_of(kappa);
  const double ab = s[1] - s[0], bc = s[2] - s[1], ac = s[2] - s[0];
  // The closest approach is a sum of the three points with these weights.
  const Three weight{s[1] * s[2] / (ab * ac), -s[0] * s[2] / (ab * bc), s[0] * s[1] / (ac * bc)};
  measured_d_ = 0;
  for (std::size_t i = 0; i < 3; ++i) measured_d_ += square(weight[i] * (*hits_)[x[i]].sigma);
  scattered_d_ =
      square(weight[1] * ab + weight[2] * ac) + square(weight[2] * bc) + square(0.5 * s[0]);  // and the pipe
  // The density of three points is that of (d, psi, kappa) over the determinant of their derivatives.
  const double sigma = 2 + 0.3 * std::abs(kappa), per_kappa = std::abs(curvature(detector_.bz, 1.0));
  double of_x = -std::log(2 * pi * sigma * std::sqrt(2 * pi) * 0.5 * per_kappa * ab * bc * ac);
  for (const std::size_t layer : layers) of_x += gain_[layer][0];
  // The same of two heights, (z0, tanl), and s.
  const Three of_v{gain_[layers[0]][1], gain_[layers[1]][1], gain_[layers[2]][1]};
  const double per_arc = std::log(std::sqrt(2 * pi) * spread_tanl);
  of_three_ = of_x + of_v[0] + of_v[1] + of_v[2] - per_arc - std::log(ac);
  of_two_ = {of_x + of_v[1] + of_v[2] + log_missed_ - per_arc - std::log(bc),
             of_x + of_v[0] + of_v[2] + log_missed_ - per_arc - std::log(ac),
             of_x + of_v[0] + of_v[1] + log_missed_ - per_arc - std::log(ab)};
  most_near_d_ = -std::log(std::sqrt(2 * pi) * std::max(std::abs(d), beam));
}

double SegmentScore::height_variance(std::size_t i, std::int32_t v) const {
  const MeasuringLayer& layer = detector_.layers[layers_[i]];
  return (square((*hits_)[x_[i]].sigma * layer.cos_stereo) + square((*hits_)[v].sigma)) /
             square(layer.sin_stereo) +
         least_error * least_error;
}

double SegmentScore::pt_of(double kappa) const {
  return settings_.momentum > 0 ? settings_.momentum : settings_.charge / std::max(std::abs(kappa), 1e-3);
}

SegmentScore::Scatter SegmentScore::scatter(double pt, double arc, double tanl) const {
  const double stretch = 1 + tanl * tanl, angle = scatter_in_layer(settings_, pt, stretch);
  return {angle, angle * square(arc * stretch)};
}

bool SegmentScore::is_far(const Scatter& scatter, double off) const {
  return off * off > square(farthest) * (scatter.middle + square(usual_error));
}

// Most tracks come from the beams' crossing, chance has no such preference.
double SegmentScore::near(const Scatter& scatter, double z0) const {
  const double variance = measured_d_ + scatter.angle * scattered_d_ + beam * beam;
  return log_sum(log_prompt_ + log_residual(d_, variance) - 0.5 * square(z0 / along), log_elsewhere_);
}

double SegmentScore::most_near(double z0) const {
  return std::max(log_prompt_ + most_near_d_ - 0.5 * square(z0 / along), log_elsewhere_) + std::log(2.0);
}

double SegmentScore::of_three(const Scatter& scatter, const std::array<std::int32_t, 3>& v, double off,
                              double z0, double least) const {
  const double part = (s_[1] - s_[0]) / (s_[2] - s_[0]);
  const Three weight{1 - part, 1, part};
  double variance = scatter.middle;
  for (std::size_t i = 0; i < 3; ++i) variance += square(weight[i]) * height_variance(i, v[i]);
  const double of_heights = of_three_ + log_residual(off, variance), most = of_heights + most_near(z0);
  return most < least ? most : of_heights + near(scatter, z0);
}

double SegmentScore::of_two(const Scatter& scatter, std::size_t first, std::size_t second, double z0) const {
  return of_two_[3 - first - second] + near(scatter, z0);
}

double SegmentScore::most_of_three(double z0) const {
  static const double residual = -std::log(std::sqrt(2 * pi) * least_error);
  return of_three_ + residual + most_near(z0);
}

double SegmentScore::most_of_two(std::size_t first, std::size_t second, double z0) const {
  return of_two_[3 - first - second] + most_near(z0);
}

}  // namespace cgemit

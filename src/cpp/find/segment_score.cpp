#include "find/segment_score.hpp"

#include <algorithm>

#include "common/units.hpp"
#include "find/score.hpp"
#include "motion/helix.hpp"

namespace cgemit {

namespace {

constexpr double thickness = 0.008;  // radiation lengths of a layer; of the beam pipe, too
constexpr double highland = 13.6 * MeV;
constexpr double least_error = 0.3;  // mm, of a height
// Of the residuals: delta electrons and noise move clusters.
constexpr double tail = 0.1, tail_width = 4;
// Particles are spread over all azimuths, and about so far in the others.
constexpr double farthest = 4, usual_error = 1.5;  // standard deviations; mm
constexpr double spread_tanl = 1;
constexpr double prompt_share = 0.9, beam = 0.5, along = 30;  // of the tracks; mm

double log_sum(double a, double b) {
  return std::max(a, b) + std::log1p(std::exp(-std::abs(a - b)));
}

// Gaussian with tails.
double log_residual(double off, double variance) {
  static const double core = std::log1p(-tail), far = std::log(tail);
  constexpr double wide = tail_width * tail_width;
  return log_sum(core + log_gaussian(off * off / variance, variance),
                 far + log_gaussian(off * off / (wide * variance), wide * variance));
}

double square(double x) { return x * x; }

}  // namespace

SegmentScore::SegmentScore(const Detector& detector, const FindSettings& settings)
    : detector_(detector),
      settings_(settings),
      log_found_(std::log(settings.efficiency)),
      log_missed_(std::log1p(-settings.efficiency)),
      gain_(detector.cgem.size()) {}

void SegmentScore::start(const EventHits& hits) {
  hits_ = &hits;
  for (std::size_t i = 0; i < gain_.size(); ++i) {
    gain_[i][0] = log_found_ - std::log(hits.density(i, View::x));
    // Densities are of V, lines are in z.
    gain_[i][1] = log_found_ - std::log(hits.density(i, View::v) * std::abs(detector_.cgem[i].sin_stereo));
  }
}

void SegmentScore::circle(const std::array<std::size_t, 3>& layers, const std::array<std::int32_t, 3>& x,
                          const Three& s, double d, double kappa) {
  layers_ = layers;
  x_ = x;
  s_ = s;
  d_ = d;
  pt_ = 1 / std::max(std::abs(kappa), 1e-3);
  const double ab = s[1] - s[0], bc = s[2] - s[1], ac = s[2] - s[0];
  // The closest approach is a sum of the three points with these weights.
  const Three weight{s[1] * s[2] / (ab * ac), -s[0] * s[2] / (ab * bc), s[0] * s[1] / (ac * bc)};
  measured_d_ = 0;
  for (std::size_t i = 0; i < 3; ++i) measured_d_ += square(weight[i] * (*hits_)[x[i]].sigma);
  scattered_d_ =
      square(weight[1] * ab + weight[2] * ac) + square(weight[2] * bc) + square(0.5 * s[0]);  // and the pipe
  // The density of three points is that of (d, psi, kappa) over the determinant of their derivatives.
  const double sigma = 2 + 0.3 * std::abs(kappa), per_kappa = std::abs(curvature(detector_.bz, 1.0));
  of_x_ = -std::log(2 * pi * sigma * std::sqrt(2 * pi)) - std::log(0.5 * per_kappa * ab * bc * ac);
  for (const std::size_t layer : layers) of_x_ += gain_[layer][0];
}

double SegmentScore::height_variance(std::size_t i, std::int32_t v) const {
  const CgemLayer& layer = detector_.cgem[layers_[i]];
  return (square((*hits_)[x_[i]].sigma * layer.cos_stereo) + square((*hits_)[v].sigma)) /
             square(layer.sin_stereo) +
         least_error * least_error;
}

// Most tracks come from the beams' crossing, chance has no such preference.
double SegmentScore::near(double variance_d, double z0) const {
  constexpr double z = along * along;
  const double off = log_residual(d_, variance_d + beam * beam) + log_gaussian(z0 * z0 / z, z);
  return log_sum(std::log(prompt_share) + off,
                 std::log((1 - prompt_share) / (4 * settings_.max_d * settings_.max_z)));
}

SegmentScore::Line SegmentScore::line(double z0, double tanl) const {
  const double stretch = 1 + tanl * tanl, p = pt_ * std::sqrt(stretch),
               beta = p / std::hypot(p, settings_.mass), angle = highland / (p * beta);
  const double scatter = angle * angle * thickness * std::sqrt(stretch);
  return {scatter * square((s_[2] - s_[1]) * stretch), near(measured_d_ + scatter * scattered_d_, z0), tanl};
}

bool SegmentScore::is_far(const Line& line, double off) const {
  return off * off > square(farthest) * (line.scattered_z + square(usual_error));
}

double SegmentScore::of_three(const Line& line, const std::array<std::int32_t, 3>& v, double off) const {
  const double part = (s_[1] - s_[0]) / (s_[2] - s_[0]);
  const Three weight{1 - part, 1, part};
  double variance = line.scattered_z, score = of_x_ + line.near - along_line(0, 2);
  for (std::size_t i = 0; i < 3; ++i) {
    variance += square(weight[i]) * height_variance(i, v[i]);
    score += gain_[layers_[i]][1];
  }
  return score + log_residual(off, variance);
}

double SegmentScore::of_two(const Line& line, std::size_t first, std::size_t second) const {
  return of_x_ + line.near - along_line(first, second) + log_missed_ + gain_[layers_[first]][1] +
         gain_[layers_[second]][1];
}

// The density of two heights is that of (z0, tanl) over their determinant.
double SegmentScore::along_line(std::size_t first, std::size_t second) const {
  return std::log(std::sqrt(2 * pi) * spread_tanl * (s_[second] - s_[first]));
}

}  // namespace cgemit

#include "reconstruction/cluster/lost_charge.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "common/units.hpp"

namespace cgemit {
namespace {

constexpr double beyond = 2;  // widths of the charge by which a position may lie outside of the strips
constexpr double steps_of_width = 8, steps_between = 8;

double below(double x) { return 0.5 * std::erfc(-x * 0.70710678118654752440); }
double density(double x) { return 0.39894228040143267794 * std::exp(-0.5 * x * x); }

// What is expected for one position of the track.
struct Expected {
  double value;           // mm, measured position
  double seen;            // share of the charge on the strips
  double silent[2];       // on the strips before and after them
  double beside, height;  // mm, means of the charge on the sheet
};
Expected between(const Expected& a, const Expected& b, double t) {
  const auto at = [t](double x, double y) { return x + t * (y - x); };
  return {at(a.value, b.value),
          at(a.seen, b.seen),
          {at(a.silent[0], b.silent[0]), at(a.silent[1], b.silent[1])},
          at(a.beside, b.beside),
          at(a.height, b.height)};
}

// Sums over Gaussians along the line of the charge, of which each is integrated over strips.
Expected expected_at(double position, const SeenStrips& strips, const ChargeProfile& profile, bool on_line) {
  const double length = std::abs(profile.slope) * profile.gap, sigma = profile.sigma;
  const int n = 1 + static_cast<int>(std::min(std::ceil(length / (0.8 * sigma)), 60.0));
  const double first = strips.middles.front() - 0.5 * strips.pitch,
               last = strips.middles.back() + 0.5 * strips.pitch;
  double seen = 0, moment = 0, silent[2] = {0, 0}, sheet = 0, beside = 0, height = 0;
  for (int k = 0; k < n; ++k) {
    const double h = profile.gap * ((k + 0.5) / n - 0.5), centre = position + profile.slope * h;
    const double at = on_line ? profile.slope * h : 0;
    double end_before = first, up_to = below((first - centre) / sigma);
    for (const double middle : strips.middles) {
      const double low = middle - 0.5 * strips.pitch, high = middle + 0.5 * strips.pitch;
      const bool behind_hole = low > end_before + 0.5 * strips.pitch;
      const double from = behind_hole ? below((low - centre) / sigma) : up_to;
      up_to = below((high - centre) / sigma);
      end_before = high;
      seen += up_to - from;
      moment += (up_to - from) * (middle - at);
    }
    const double before = (first - centre) / sigma, after = (last - centre) / sigma;
    silent[0] += below(before) - below(before - strips.pitch / sigma);
    silent[1] += below(after + strips.pitch / sigma) - below(after);
    // Charge that is uneven leaves strips silent where it has none: it loses nothing there.
    if (profile.fluctuates && strips.silent_below) {
      seen += below(before);
      moment += (centre - at) * below(before) - sigma * density(before);
    }
    if (profile.fluctuates && strips.silent_above) {
      seen += below(-after);
      moment += (centre - at) * below(-after) + sigma * density(after);
    }
    const double begin = (strips.edge_below - centre) / sigma, end = (strips.edge_above - centre) / sigma;
    const double part = below(end) - below(begin);
    sheet += part;
    beside += sigma * (density(begin) - density(end));
    height += part * h;
  }
  const double least = 1e-12;
  return {moment / std::max(seen, least),
          seen / n,
          {silent[0] / n, silent[1] / n},
          beside / std::max(sheet, least),
          height / std::max(sheet, least)};
}

// Logarithm of the likelihood of what is seen.
double likelihood(const Expected& expected, const SeenStrips& strips, const MeasuredCharge& measured) {
  const double seen = std::max(expected.seen, 1e-9);
  double found = -0.5 * square(measured.position - expected.value) / measured.variance;
  // The charge of particles has a long tail.
  const double apart = (std::log(measured.charge / seen) - measured.log_charge) / measured.charge_spread;
  found -= std::log1p(apart * apart);
  const bool says[2] = {strips.silent_below, strips.silent_above};
  for (int side = 0; side < 2; ++side) {
    if (!says[side]) continue;
    const double charge = measured.charge * expected.silent[side] / seen;
    const double spread = std::sqrt(square(measured.noise) + measured.uneven * measured.charge * charge);
    found += std::log(std::max(below((measured.threshold - charge) / spread), 1e-12));
  }
  return found;
}

}  // namespace

FoundPosition position_of_seen(const SeenStrips& strips, const ChargeProfile& profile,
                               const MeasuredCharge& measured) {
  const double reach = 0.5 * std::abs(profile.slope) * profile.gap + beyond * profile.sigma;
  const double low = strips.middles.front() - 0.5 * strips.pitch - reach,
               high = strips.middles.back() + 0.5 * strips.pitch + reach;
  const auto steps = static_cast<std::size_t>(std::ceil((high - low) / profile.sigma * steps_of_width));
  const double step = (high - low) / static_cast<double>(steps);
  double most = -std::numeric_limits<double>::infinity(), sum = 0;
  // Weighted sums about the most likely position so far.
  double mean = 0, squares = 0, beside = 0, beside_squares = 0, height = 0;
  Expected here = expected_at(low, strips, profile, measured.on_line);
  for (std::size_t i = 0; i < steps; ++i) {
    const double position = low + static_cast<double>(i) * step;
    const Expected next = expected_at(position + step, strips, profile, measured.on_line);
    for (int k = 0; k < static_cast<int>(steps_between); ++k) {
      const double t = (k + 0.5) / steps_between;
      const Expected one = between(here, next, t);
      const double log_weight = likelihood(one, strips, measured);
      if (log_weight > most) {
        const double scale = std::exp(most - log_weight);
        for (double* const total : {&sum, &mean, &squares, &beside, &beside_squares, &height})
          *total *= scale;
        most = log_weight;
      }
      const double weight = std::exp(log_weight - most), x = position + t * step - measured.position;
      sum += weight;
      mean += weight * x;
      squares += weight * x * x;
      beside += weight * one.beside;
      beside_squares += weight * one.beside * one.beside;
      height += weight * one.height;
    }
    here = next;
  }
  mean /= sum;
  beside /= sum;
  return {measured.position + mean, std::max(squares / sum - mean * mean, 0.0), beside,
          std::max(beside_squares / sum - beside * beside, 0.0), height / sum};
}

}  // namespace cgemit

#include "reconstruction/cluster/lost_charge.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "common/units.hpp"

namespace cgemit {
namespace {

constexpr double beyond = 2;  // widths of the charge by which a position may lie outside of the strips
constexpr double steps_of_width = 5, nodes_of_width = 1.25;
constexpr int steps_between = 8;

double normal_below(double x) { return 0.5 * std::erfc(-x * 0.70710678118654752440); }
double normal_density(double x) { return 0.39894228040143267794 * std::exp(-0.5 * x * x); }

// Of one Gaussian of the charge: shares of the strips, and of the sheet.
struct Part {
  double seen, moment;   // moment: mm, sum over the strips of their middles
  double silent[2];      // of the strips before and after
  double sheet, beside;  // beside: mm, sum over the sheet of the distance from the centre
};

Part part_at(double centre, const SeenStrips& strips, const ChargeProfile& profile) {
  const double sigma = profile.sigma, pitch = strips.pitch;
  const double first = strips.middles.front() - 0.5 * pitch, last = strips.middles.back() + 0.5 * pitch;
  const double before = (first - centre) / sigma, after = (last - centre) / sigma;
  const double up_to_first = normal_below(before);
  Part part{};
  double end_before = first, up_to = up_to_first;
  for (const double middle : strips.middles) {
    const double low = middle - 0.5 * pitch, high = middle + 0.5 * pitch;
    const bool behind_hole = low > end_before + 0.5 * pitch;
    const double from = behind_hole ? normal_below((low - centre) / sigma) : up_to;
    up_to = normal_below((high - centre) / sigma);
    end_before = high;
    part.seen += up_to - from;
    part.moment += (up_to - from) * middle;
  }
  part.silent[0] = up_to_first - normal_below(before - pitch / sigma);
  part.silent[1] = normal_below(after + pitch / sigma) - up_to;
  // Charge that is uneven leaves strips silent where it has none: it loses nothing there.
  if (profile.fluctuates && strips.silent_below) {
    part.seen += up_to_first;
    part.moment += centre * up_to_first - sigma * normal_density(before);
  }
  if (profile.fluctuates && strips.silent_above) {
    part.seen += normal_below(-after);
    part.moment += centre * normal_below(-after) + sigma * normal_density(after);
  }
  const double begin = (strips.edge_below - centre) / sigma, end = (strips.edge_above - centre) / sigma;
  part.sheet = normal_below(end) - normal_below(begin);
  part.beside = sigma * (normal_density(begin) - normal_density(end));
  return part;
}

// What is expected for one position of the track.
struct Expected {
  double value;      // mm, measured position
  double seen;       // share of the charge on the strips
  double silent[2];  // on the strips before and after them
  double beside;     // mm, mean of the charge on the sheet
};
Expected between(const Expected& a, const Expected& b, double t) {
  const auto at = [t](double x, double y) { return x + t * (y - x); };
  return {at(a.value, b.value),
          at(a.seen, b.seen),
          {at(a.silent[0], b.silent[0]), at(a.silent[1], b.silent[1])},
          at(a.beside, b.beside)};
}

// The charge at equal steps of the position: Gaussians at nodes along its line, which are whole steps apart.
class ExpectedCharge {
 public:
  ExpectedCharge(const SeenStrips& strips, const ChargeProfile& profile, bool on_line) : on_line_(on_line) {
    const double length = std::abs(profile.slope) * profile.gap, sigma = profile.sigma;
    nodes_ = 1 + static_cast<std::size_t>(std::min(std::ceil(length / sigma * nodes_of_width), 60.0));
    const double apart = length / static_cast<double>(nodes_);
    stride_ = static_cast<std::size_t>(std::ceil(apart / sigma * steps_of_width));
    step_ = stride_ > 0 ? apart / static_cast<double>(stride_) : sigma / steps_of_width;
    const double reach = 0.5 * length + beyond * sigma;
    const double middle = 0.5 * (strips.middles.front() + strips.middles.back());
    const double range = strips.middles.back() - strips.middles.front() + strips.pitch + 2 * reach;
    steps_ = static_cast<std::size_t>(std::ceil(range / step_));
    low_ = middle - 0.5 * static_cast<double>(steps_) * step_;  // so that both edges of a sheet are alike
    half_ = 0.5 * static_cast<double>((nodes_ - 1) * stride_) * step_;
    const std::size_t n = steps_ + 1 + (nodes_ - 1) * stride_;
    parts_.reserve(n);
    for (std::size_t i = 0; i < n; ++i)
      parts_.push_back(part_at(low_ - half_ + static_cast<double>(i) * step_, strips, profile));
  }
  std::size_t steps() const { return steps_; }
  double step() const { return step_; }
  double position(std::size_t i) const { return low_ + static_cast<double>(i) * step_; }

  Expected at(std::size_t i) const {
    Part sum{};
    for (std::size_t k = 0; k < nodes_; ++k) {
      const Part& part = parts_[i + k * stride_];
      const double along = on_line_ ? static_cast<double>(k * stride_) * step_ - half_ : 0;
      sum.seen += part.seen;
      sum.moment += part.moment - along * part.seen;
      sum.silent[0] += part.silent[0];
      sum.silent[1] += part.silent[1];
      sum.sheet += part.sheet;
      sum.beside += part.beside;
    }
    constexpr double least = 1e-12;
    const auto n = static_cast<double>(nodes_);
    return {sum.moment / std::max(sum.seen, least),
            sum.seen / n,
            {sum.silent[0] / n, sum.silent[1] / n},
            sum.beside / std::max(sum.sheet, least)};
  }

 private:
  bool on_line_;
  std::size_t nodes_, stride_, steps_;
  double step_, low_, half_;  // mm
  std::vector<Part> parts_;
};

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
    found += std::log(std::max(normal_below((measured.threshold - charge) / spread), 1e-12));
  }
  return found;
}

}  // namespace

FoundPosition position_of_seen(const SeenStrips& strips, const ChargeProfile& profile,
                               const MeasuredCharge& measured) {
  const ExpectedCharge charge(strips, profile, measured.on_line);
  double most = -std::numeric_limits<double>::infinity(), sum = 0;
  // Sums weighted by the likelihood over the largest one so far.
  double mean = 0, squares = 0, beside = 0, beside_squares = 0;
  Expected here = charge.at(0);
  for (std::size_t i = 0; i < charge.steps(); ++i) {
    const Expected next = charge.at(i + 1);
    for (int k = 0; k < steps_between; ++k) {
      const double t = (k + 0.5) / steps_between;
      const Expected one = between(here, next, t);
      const double log_weight = likelihood(one, strips, measured);
      if (log_weight > most) {
        const double scale = std::exp(most - log_weight);
        for (double* const total : {&sum, &mean, &squares, &beside, &beside_squares}) *total *= scale;
        most = log_weight;
      }
      const double weight = std::exp(log_weight - most);
      const double x = charge.position(i) + t * charge.step() - measured.position;
      sum += weight;
      mean += weight * x;
      squares += weight * x * x;
      beside += weight * one.beside;
      beside_squares += weight * one.beside * one.beside;
    }
    here = next;
  }
  mean /= sum;
  beside /= sum;
  return {measured.position + mean, std::max(squares / sum - mean * mean, 0.0), beside,
          std::max(beside_squares / sum - beside * beside, 0.0)};
}

}  // namespace cgemit

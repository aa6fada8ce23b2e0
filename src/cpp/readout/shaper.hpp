// Response of a front-end amplifier as a sum of damped terms, so that a train of currents is filtered in one
// pass.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <span>
#include <stdexcept>
#include <vector>

namespace cgemit {

// Response to a unit charge at time 0: the sum of (a + b u) exp(-rate u) for u = t - delay > 0. One for the
// peak: `cgemit.detector.readouts.Shaper` normalises it.
struct ShaperTerm {
  double a, b, rate;  // 1, 1/ns, 1/ns
};

struct Shaper {
  static constexpr std::size_t most = 4;
  std::array<ShaperTerm, most> terms{};
  std::size_t n = 0;
  double delay = 0;  // ns

  Shaper(std::span<const double> rows, double delayed) : delay(delayed) {
    if (rows.empty() || rows.size() % 3 != 0 || rows.size() > 3 * most) {
      throw std::invalid_argument("shaper: expected 1 to 4 terms of 3 numbers");
    }
    for (; n < rows.size() / 3; ++n) {
      terms[n] = {rows[3 * n], rows[3 * n + 1], rows[3 * n + 2]};
      if (!(terms[n].rate > 0)) throw std::invalid_argument("shaper: expected positive rates");
    }
  }
};

// Amplitude at equidistant times for a current that is constant between them, filtered from one time to the
// next. The response to a step of the current is the integral of the response to a charge,
//   a/rate + b/rate^2 - exp(-rate u) (a/rate + b/rate^2 + b u/rate).
//
// `n`: number of terms; more than the shaper has do nothing.
template <std::size_t n>
class StepFilter {
 public:
  StepFilter(const Shaper& shaper, double dt) {
    for (std::size_t k = 0; k < std::min(n, shaper.n); ++k) {
      const ShaperTerm& term = shaper.terms[k];
      const double constant = term.a / term.rate + term.b / (term.rate * term.rate);
      level_ += constant;
      constant_[k] = constant;
      slope_[k] = term.b / term.rate;
      decay_[k] = std::exp(-term.rate * dt);
      fading_[k] = decay_[k] * dt;
    }
  }
  // Goes on to the next time and adds a step of the current (fC/ns) there; returns the amplitude (fC),
  // without the shaper's delay.
  double next(double step) {
    double amplitude = level_ * current_;
    for (std::size_t k = 0; k < n; ++k) {
      amplitude -= constant_[k] * plain_[k] + slope_[k] * linear_[k];
      // One product waits for the number before it, not two.
      linear_[k] = decay_[k] * linear_[k] + fading_[k] * (plain_[k] + step);
      plain_[k] = decay_[k] * plain_[k] + decay_[k] * step;
    }
    current_ += step;
    return amplitude;
  }

 private:
  double level_ = 0, current_ = 0;
  std::array<double, n> constant_{}, slope_{}, decay_{}, fading_{};  // 1, 1/ns, 1, ns
  std::array<double, n> plain_{}, linear_{};  // sums of exp(-rate u) and of u exp(-rate u) at the next time
};

// Calls f with a filter that has as many terms as the shaper.
template <class F>
auto filtered(const Shaper& shaper, double dt, F&& f) {
  if (shaper.n == 1) return f(StepFilter<1>(shaper, dt));
  if (shaper.n == 2) return f(StepFilter<2>(shaper, dt));
  if (shaper.n == 3) return f(StepFilter<3>(shaper, dt));
  return f(StepFilter<Shaper::most>(shaper, dt));
}

// Amplitudes k steps of the grid after a step of the current of 1 fC/ns, computed as far as they are needed.
class StepResponse {
 public:
  StepResponse(const Shaper& shaper, double dt) : filter_(shaper, dt), amplitudes_{filter_.next(1.0)} {}
  // The amplitudes, at least up to number `last`; valid until the next call.
  const double* up_to(std::size_t last) {
    while (amplitudes_.size() <= last) amplitudes_.push_back(filter_.next(0.0));
    return amplitudes_.data();
  }

 private:
  StepFilter<Shaper::most> filter_;
  std::vector<double> amplitudes_;
};

}  // namespace cgemit

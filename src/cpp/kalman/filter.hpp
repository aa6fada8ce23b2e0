// The Kalman filter and its smoother for a constant state.
//
// The state is the helix at the origin, (d, psi, kappa, z0, tanl), as a deviation x from a reference. Every
// measurement is a row h in these five coordinates. Every scatterer is a set of vectors g: the change of the
// track beyond the scatterer, extrapolated to the origin. The transition matrix is 1. (Fruehwirth, NIM A 262
// (1987) 444; smoother in the form of Bierman, Automatica 9 (1973) 503, modified Bryson-Frazier.)
#pragma once

#include "common/compiler.hpp"
#include "kalman/group.hpp"

namespace cgemit {

template <class T>
struct FilteredState {
  Five<T> x;
  Symmetric<T> c;
  T chi2;
};

// Whether the state is finite and its chi-square is not negative, as rounding of a variance could make it.
template <class T>
mask_of<T> sound(const FilteredState<T>& estimate) {
  T sum = 0.0 * estimate.chi2;
  unroll<parameters>([&](auto i) { sum += 0.0 * estimate.x[i] + 0.0 * estimate.c(i, i); });
  return (sum == 0.0) & (estimate.chi2 >= 0.0);
}

template <class T>
void add_noise(Symmetric<T>& c, const SlabNoise<T>& noise, bool shifts) {
  c.add([&](auto i, auto j) { return noise.dip[i] * noise.dip[j]; });
  c.add([&](auto i, auto j) {
    if constexpr (j < 4)
      return noise.straggling[i] * noise.straggling[j];
    else
      return T(0.0);
  });
  const auto sparse = [&c](const std::array<T, 3>& g) {
    c(0, 0) += g[0] * g[0];
    c(0, 1) += g[0] * g[1];
    c(0, 3) += g[0] * g[2];
    c(1, 1) += g[1] * g[1];
    c(1, 3) += g[1] * g[2];
    c(3, 3) += g[2] * g[2];
  };
  sparse(noise.turn);
  if (!shifts) return;
  sparse(noise.shift_across);
  sparse(noise.shift_along);
}

template <class T>
void add_noise(Symmetric<T>& c, const DenseNoise<T>& noise, bool shifts) {
  const auto add = [&c](const Five<T>& g) { c.add([&g](auto i, auto j) { return g[i] * g[j]; }); };
  add(noise.turn);
  add(noise.dip);
  add(noise.straggling);
  if (!shifts) return;
  add(noise.shift_across);
  add(noise.shift_along);
}

// Diagonal of the covariance that all slabs add. Their shifts, which are smaller than the turns, are left
// out.
template <class T>
Five<T> noise_variances(const Group<T>& group) {
  Five<T> sum = Five<T>::zero();
  const auto add = [&sum](int i, const T& g) { sum[i] += g * g; };
  if (group.dense) {
    for (const DenseNoise<T>& noise : group.dense_noise)
      unroll<parameters>([&](auto i) {
        for (const Five<T>* g : {&noise.turn, &noise.dip, &noise.straggling}) add(i, (*g)[i]);
      });
    return sum;
  }
  for (const SlabNoise<T>& noise : group.noise) {
    unroll<parameters>([&](auto i) { add(i, noise.dip[i]); });
    unroll<4>([&](auto i) { add(i, noise.straggling[i]); });
    add(0, noise.turn[0]);
    add(1, noise.turn[1]);
    add(3, noise.turn[2]);
  }
  return sum;
}

// The noise is centred on the kink that the reference already has.
template <class T>
void take_kink(Five<T>& x, const SlabNoise<T>& noise, const Kink<T>& kink) {
  const auto [turn, dip] = in_noise_units(kink);
  x = x + dip * noise.dip;
  x[0] += turn * noise.turn[0];
  x[1] += turn * noise.turn[1];
  x[3] += turn * noise.turn[2];
}

template <class T>
void take_kink(Five<T>& x, const DenseNoise<T>& noise, const Kink<T>& kink) {
  const auto [turn, dip] = in_noise_units(kink);
  x = x + turn * noise.turn + dip * noise.dip;
}

// One measurement. An unused measurement leaves the state unchanged, but its residual is computed. Without
// `residuals` only the covariance is computed.
template <bool residuals = true, class T>
void update(FilteredState<T>& state, Slot<T>& slot) {
  slot.ch = state.c * slot.row;
  slot.total = dot(slot.row, slot.ch) + slot.variance;
  slot.inverse = select(slot.used, 1.0 / slot.total, T(0.0));
  const Five<T> gain = slot.inverse * slot.ch;
  if constexpr (residuals) {
    slot.innovation = slot.residual - dot(slot.row, state.x);
    state.x = state.x + slot.innovation * gain;
    state.chi2 += slot.innovation * slot.innovation * slot.inverse;
  }
  state.c.add([&](auto i, auto j) { return -(gain[i] * slot.ch[j]); });
}

// From the outermost measurement inward to the origin.
template <bool residuals = true, class T>
CGEMIT_FLATTEN FilteredState<T> filter(const Detector& detector, Group<T>& group, const Symmetric<T>& prior) {
  FilteredState<T> state{Five<T>::zero(), prior, T(0.0)};
  for (std::size_t i = group.steps.size(); i-- > 0;) {
    const GroupStep& step = group.steps[i];
    if (step.is_slab) {
      const bool shifts = detector.slabs[static_cast<std::size_t>(step.slab)].shifts;
      const auto noise = static_cast<std::size_t>(step.noise);
      if (any(group.ahead[noise])) {
        const auto take = [&](const auto& noise_here) {
          add_noise(state.c, noise_here, shifts);
          if (any(group.kinked)) take_kink(state.x, noise_here, group.kinks[noise]);
        };
        if (group.dense) {
          take(group.dense_noise[noise]);
        } else {
          take(group.noise[noise]);
        }
      }
    }
    for (std::int32_t s = step.last; s-- > step.first;)
      update<residuals>(state, group.slots[static_cast<std::size_t>(s)]);
  }
  return state;
}

// The turn and the change of dip, in units of their standard deviations.
template <class T>
std::array<T, 2> seen(const SlabNoise<T>& noise, const Five<T>& lambda) {
  return {noise.turn[0] * lambda[0] + noise.turn[1] * lambda[1] + noise.turn[2] * lambda[3],
          dot(noise.dip, lambda)};
}
template <class T>
std::array<T, 2> seen(const DenseNoise<T>& noise, const Five<T>& lambda) {
  return {dot(noise.turn, lambda), dot(noise.dip, lambda)};
}

// From the origin outward: the residual of every measurement to the track fitted without it, and, for lanes
// `who` with kinks, the smoothed kinks.
template <class T>
CGEMIT_FLATTEN void smooth(Group<T>& group, mask_of<T> who) {
  who = who & group.kinked;
  Five<T> lambda = Five<T>::zero();
  Symmetric<T> big_lambda = Symmetric<T>::diagonal(Five<T>::zero());
  for (const GroupStep& step : group.steps) {
    for (std::int32_t s = step.first; s < step.last; ++s) {
      Slot<T>& slot = group.slots[static_cast<std::size_t>(s)];
      const T weight = slot.inverse;
      const Five<T> lk = big_lambda * slot.ch;
      const T known = dot(slot.ch, lk);  // reduction of the predicted variance by the inner measurements
      const T away = slot.innovation + dot(slot.ch, lambda), share = 1.0 / (1.0 + weight * known);
      slot.unbiased = away * share;
      slot.unbiased_variance = select(slot.used, slot.total * share, slot.total - known);
      const T information = weight * (1.0 + weight * known);
      const T u = weight * away;
      lambda = lambda - u * slot.row;
      const Five<T> part = weight * lk, rest = information * slot.row - part;
      big_lambda.add([&](auto i, auto j) { return slot.row[i] * rest[j] - part[i] * slot.row[j]; });
    }
    if (!step.is_slab || !any(who)) continue;
    const auto noise = static_cast<std::size_t>(step.noise);
    Kink<T>& kink = group.kinks[noise];
    const auto [turn, dip] =
        group.dense ? seen(group.dense_noise[noise], lambda) : seen(group.noise[noise], lambda);
    kink.aside = select(who, kink.sigma * (kink.cosine * turn - kink.sine * dip), kink.aside);
    kink.up = select(who, kink.sigma * (kink.cosine * dip + kink.sine * turn), kink.up);
  }
}

}  // namespace cgemit

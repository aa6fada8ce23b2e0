// Errors of clusters that a readout gives, for the angle of each track.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "common/lanes/pack.hpp"
#include "covariance/covariance.hpp"

namespace cgemit {

template <class T>
class GivenErrors {
 public:
  GivenErrors(const HitModel& model, const T& tanl) : model_(model), knots_(model.cos_theta.size()) {
    if (knots_ == 1) return;
    const std::vector<double>& at = model.cos_theta;
    share_ = gathered<T>([&](int i) {
      const double slope = lane(tanl, i);
      const double cos_theta = std::clamp(slope / std::sqrt(1 + slope * slope), at.front(), at.back());
      const auto above = std::upper_bound(at.begin() + 1, at.end() - 1, cos_theta);
      below_[static_cast<std::size_t>(i)] = static_cast<std::size_t>(above - at.begin()) - 1;
      return (cos_theta - above[-1]) / (above[0] - above[-1]);
    });
  }

  // Whether errors do not follow from the number of strips.
  bool has(View view, std::size_t layer) const { return of(view)[layer * knots_] > 0; }

  // Of V, the variance of V - k X, which is not correlated with X.
  T variance(View view, std::size_t layer) const {
    const T own = at(of(view), layer);
    if (view == View::x) return own * own;
    const T correlation = at(model_.corr_xv, layer);
    return own * own * (1.0 - correlation * correlation);
  }
  T k(std::size_t layer) const {
    if (!has(View::x, layer) || !has(View::v, layer)) return T(0.0);
    return at(model_.corr_xv, layer) * at(model_.sigma_v, layer) / at(model_.sigma_x, layer);
  }

 private:
  const std::vector<double>& of(View view) const { return view == View::x ? model_.sigma_x : model_.sigma_v; }
  T at(const std::vector<double>& values, std::size_t layer) const {
    const double* const own = &values[layer * knots_];
    if (knots_ == 1) return T(*own);
    const T low = gathered<T>([&](int i) { return own[below_[static_cast<std::size_t>(i)]]; });
    const T high = gathered<T>([&](int i) { return own[below_[static_cast<std::size_t>(i)] + 1]; });
    return low + share_ * (high - low);
  }

  const HitModel& model_;
  std::size_t knots_;
  std::array<std::size_t, lanes_of<T>> below_{};  // knot below each lane's track
  T share_{0.0};                                  // of the way to the next one
};

}  // namespace cgemit

// Random numbers one after the other, where it is not known beforehand how many are needed.
#pragma once

#include <algorithm>
#include <cmath>

#include "common/rng.hpp"

namespace cgemit {

// The uniform numbers of one purpose at one place.
class Draws {
 public:
  Draws(const Stream& stream, Purpose purpose, std::uint32_t place)
      : stream_(stream), purpose_(purpose), place_(place) {}
  double next() {
    if (used_ == 4) {
      words_ = stream_.block(purpose_, place_, block_++);
      used_ = 0;
    }
    return open_unit(words_[used_++]);
  }

 private:
  const Stream& stream_;
  Purpose purpose_;
  std::uint32_t place_, block_ = 0;
  std::size_t used_ = 4;
  Block words_{};
};

// Poisson number at a quantile counted from the top: the usual none costs no exponential. Large numbers by
// Cornish and Fisher's expansion about the normal quantile, wrong by less than 0.01.
inline int poisson(double u, double mean) {
  if (u >= mean) return 0;  // 1 - exp(-mean) < mean
  if (mean > 200) {
    const double z = -normal_quantile(u);
    return std::max(static_cast<int>(mean + std::sqrt(mean) * z + (z * z - 1) / 6 + 0.5), 0);
  }
  double term = std::exp(-mean), sum = term;
  int n = 0;
  while (1 - u > sum && term > 0) {
    term *= mean / ++n;
    sum += term;
  }
  return n;
}

}  // namespace cgemit

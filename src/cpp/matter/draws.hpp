// Random numbers drawn one after the other, for code that does not know in advance how many it needs.
#pragma once

#include <algorithm>
#include <cmath>

#include "common/lanes/philox.hpp"

namespace cgemit {

// The uniform random numbers of one purpose at one `place`, for a single particle or one per lane.
template <class T>
class DrawsOf {
 public:
  DrawsOf(const StreamOf<T>& stream, Purpose purpose, std::uint32_t place)
      : stream_(stream), purpose_(purpose), place_(place) {}
  // Continues the sequence of one lane of `others`.
  template <class Others>
  DrawsOf(const StreamOf<T>& stream, const Others& others, int i)
      : stream_(stream),
        purpose_(others.purpose_),
        place_(others.place_),
        block_(others.block_),
        used_(others.used_) {
    for (std::size_t k = 0; k < 4; ++k) words_[k] = word(others.words_[k], i);
  }
  T next() {
    if (used_ == 4) {
      words_ = stream_.block(purpose_, place_, block_++);
      used_ = 0;
    }
    return open_unit(words_[used_++]);
  }

 private:
  template <class Other>
  friend class DrawsOf;
  const StreamOf<T>& stream_;
  Purpose purpose_;
  std::uint32_t place_, block_ = 0;
  std::size_t used_ = 4;
  BlockOf<T> words_{};
};
using Draws = DrawsOf<double>;

// Poisson number at a quantile counted from the top. The common result 0 needs no exponential. For large
// numbers the Cornish-Fisher expansion about the normal quantile is used, with an error below 0.01.
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

#if CGEMIT_VECTORS
// The same in lanes; the results are integers.
template <int W>
Pack<W> poisson(Pack<W> u, Pack<W> mean) {
  Pack<W> n(0.0);
  if (all(u >= mean)) return n;
  const Mask<W> large = mean > 200.0;
  each_lane(large, [&](int i) { n.set(i, poisson(u[i], mean[i])); });
  mean = select(large, 0.0, mean);
  Pack<W> term = exp(-mean), sum = term;
  for (Mask<W> more = (1.0 - u > sum) & (u < mean); any(more); more = more & (1.0 - u > sum) & (term > 0.0)) {
    n = select(more, n + 1.0, n);
    term *= mean / larger(n, 1.0);
    sum += term;
  }
  return n;
}
#endif

}  // namespace cgemit

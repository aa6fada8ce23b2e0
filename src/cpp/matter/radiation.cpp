#include "matter/radiation.hpp"

#include <cmath>

#include "matter/draws.hpp"

namespace cgemit {

double sample_radiation(double energy, double x0, const Stream& stream, std::uint32_t place) {
  constexpr double least = 1e-3;  // softer photons are included by their mean
  static const double log_least = std::log(least);
  Draws draws(stream, Purpose::radiation, place);
  double left = 1 - 4.0 / 3 * least * x0;
  // Photons are proposed with (4/3)/y and accepted with the ratio of the spectrum to this.
  for (int n = poisson(draws.next(), -4.0 / 3 * log_least * x0); n > 0; --n) {
    const double y = std::exp(draws.next() * log_least);
    if (draws.next() < 1 - y + 0.75 * y * y) left *= 1 - y;
  }
  return energy * (1 - left);
}

}  // namespace cgemit

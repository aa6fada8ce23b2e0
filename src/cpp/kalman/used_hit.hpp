// A measurement as the last iteration of a fit used it.
#pragma once

#include <cstdint>
#include <tuple>

#include "common/columns.hpp"

namespace cgemit {

struct UsedHit {
  std::uint8_t used;  // 0: an outlier
  double value;       // mm, of a wire with the sign of its side
  double variance;    // mm^2

  static constexpr auto columns() {
    return std::tuple(Column("used", &UsedHit::used), Column("used_value", &UsedHit::value),
                      Column("used_variance", &UsedHit::variance));
  }
};

}  // namespace cgemit

// How well layers without strips measure, in digitizing and in clusters.
#pragma once

#include <tuple>

#include "common/columns.hpp"

namespace cgemit {

// How one layer measures positions.
struct PositionErrors {
  double sigma_x, sigma_v;  // mm, of X = r_readout dphi and of V; 0 in digitizing: the middle of a strip
  double sigma_time;        // ns

  static constexpr auto columns() {
    return std::tuple(Column("sigma_x", &PositionErrors::sigma_x),
                      Column("sigma_v", &PositionErrors::sigma_v),
                      Column("sigma_time", &PositionErrors::sigma_time));
  }
};

}  // namespace cgemit

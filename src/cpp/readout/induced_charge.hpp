// Charge that an avalanche induces on strips.
#pragma once

#include <array>
#include <cstddef>
#include <span>

namespace cgemit {

// Charge that an avalanche of charge 1 induces on the strips around it (`cgemit.detector.induction`). Between
// the nodes of its way through the induction gap the current is constant.
struct InducedCharge {
  static constexpr std::size_t nodes = 5;
  std::array<double, nodes> way;      // share of the induction gap behind it at each node, from 0 to 1
  std::size_t phases = 0, reach = 0;  // places within a strip, without the last edge; strips on either side
  // Of X, then of V of all layers: (phases + 1, nodes, 2 reach + 1), by place and strip.
  std::span<const double> charge;

  std::size_t strips() const { return 2 * reach + 1; }
  std::size_t plane_size() const { return (phases + 1) * nodes * strips(); }
};

}  // namespace cgemit

// When a chip measures the charge of a strip, after the mean arrival of that charge: the mean over tracks
// whose ionization fluctuates (docs/methods/readout.md).
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "readout/chips.hpp"
#include "readout/induced_charge.hpp"

namespace cgemit {

// One view of a layer.
struct StripView {
  InducedCharge induced;  // of this view alone
  double pitch, gap;      // mm, of the strips; of the drift
  double velocity;        // mm/ns, in the drift gap
  double duration;        // ns, of the way through the induction gap
  double margin;          // mm, of the charge beside the track, in which strips lie
  double threshold;       // fC
};

// Tracks through the gap, each beside a strip.
struct DriftingTracks {
  std::span<const std::int64_t> first;  // cluster of each track, and the number of all
  std::span<const double> height;       // of each cluster, in gaps from the middle
  std::span<const double> charge;       // of each cluster
  std::span<const double> place;        // of each track's strip, in widths of a cluster from its middle
};

// Delays, ns, of charges (fC, growing) for tracks of each slope across the strips, (slopes, charges): means
// over the tracks, weighted with the charge of their strips.
std::vector<double> strip_delays(const Chip& chip, const StripView& view, const DriftingTracks& tracks,
                                 std::span<const double> slopes, std::span<const double> charges);

}  // namespace cgemit

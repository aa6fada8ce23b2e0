// Cells and strips that fire without a particle of the event (docs/methods/background.md). What fires is a
// function of seed, event and place, so that it depends on no other event.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <tuple>
#include <vector>

#include "common/columns.hpp"
#include "detector/detector.hpp"

namespace cgemit {

// Channels that fire on their own, whatever their neighbours do.
struct HotChannels {
  std::span<const std::int32_t> gid;
  std::span<const double> fires;  // probability of each in an event
};

struct CellNoise {
  std::span<const double> begins;   // for each wire layer: probability that a run of cells begins at a cell
  std::span<const double> lengths;  // running sum of the shares of runs of 1, 2, 3 ... cells; the last is 1
  double window;                    // ns; times are uniform in it
  HotChannels hot;
  std::uint64_t seed;
};

// Ordered by event; a cell may be there twice.
struct NoisyCells {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> layer, wire, gid;  // layer: the experiment's number
  std::vector<double> drift_time;              // ns

  static constexpr auto columns() {
    return std::tuple(Column("event", &NoisyCells::event), Column("layer", &NoisyCells::layer),
                      Column("wire", &NoisyCells::wire), Column("gid", &NoisyCells::gid),
                      Column("drift_time", &NoisyCells::drift_time));
  }
};

NoisyCells background_cells(const Detector& detector, std::span<const std::int64_t> events,
                            const CellNoise& noise);

struct StripNoise {
  std::span<const double> clusters;  // for each layer: mean number in the window, 0 without strips
  int most_strips;                   // of a cluster in each view; from 1, as probable as each other
  std::span<const double> single;    // probability that an X, then a V strip of each layer fires alone
  std::array<double, 2> charge;      // fC, of strips of clusters; uniform from the first to the second
  std::array<double, 2> noise;       // fC, of single and hot strips
  double window;                     // ns; times are uniform in it
  HotChannels hot;
  std::uint64_t seed;
};

// Ordered by event and gid; each strip is there once.
struct NoisyStrips {
  std::vector<std::int64_t> event;
  std::vector<std::int32_t> layer, sheet, strip, gid;
  std::vector<std::int8_t> view;     // 0 X, 1 V
  std::vector<double> charge, time;  // fC, ns

  static constexpr auto columns() {
    return std::tuple(Column("event", &NoisyStrips::event), Column("layer", &NoisyStrips::layer),
                      Column("sheet", &NoisyStrips::sheet), Column("view", &NoisyStrips::view),
                      Column("strip", &NoisyStrips::strip), Column("gid", &NoisyStrips::gid),
                      Column("charge", &NoisyStrips::charge), Column("time", &NoisyStrips::time));
  }
};

NoisyStrips background_strips(const Detector& detector, std::span<const std::int64_t> events,
                              const StripNoise& noise);

// Rows in the order of event, channel and time. Rows that are equal in all three keep their order.
struct ChannelOrder {
  std::vector<std::int64_t> rows;
  std::vector<std::int64_t> first;  // index into `rows` of the first row of each event and channel
};

ChannelOrder by_channel(std::span<const std::int64_t> event, std::span<const std::int32_t> gid,
                        std::span<const double> time);

}  // namespace cgemit

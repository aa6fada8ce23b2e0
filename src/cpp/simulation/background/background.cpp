#include "simulation/background/background.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <tuple>

#include "detector/strip_plane.hpp"
#include "matter/draws.hpp"
#include "readout/strip_maps.hpp"

namespace cgemit {
namespace {

// The block of a channel (Purpose::background_cell, Purpose::background_strip) in the order of its words:
//   cell:  time of noise, whether it fires as a hot one, time as a hot one, whether it is read out
//   strip: charge, time, whether it fires as a hot one, whether it is read out
// Whether a channel is read out is drawn in cgemit.simulation.background.
constexpr int most_in_layer = 1000;  // of a layer

Stream stream_of(std::uint64_t seed, std::int64_t event) {
  return {seed, static_cast<std::uint64_t>(event), 0};
}

// Calls `fire` for each of n channels that fires, all with the same probability: the number of silent ones
// before the next is geometric.
template <class Fire>
void each_fired(Draws& draws, int n, double probability, Fire&& fire) {
  if (probability <= 0) return;
  const double per_log = 1 / std::log1p(-probability);
  const auto silent = [&] { return std::floor(per_log * std::log(draws.next())); };
  for (double next = silent(); next < n; next += 1 + silent()) fire(static_cast<int>(next));
}

// Number of cells of a run.
int run_length(std::span<const double> lengths, Draws& draws) {
  if (lengths.size() < 2) return 1;
  const auto at = std::lower_bound(lengths.begin(), lengths.end() - 1, draws.next());
  return 1 + static_cast<int>(at - lengths.begin());
}

void add_cell(const WireLayer& layer, int wire, std::int64_t event, double time, NoisyCells& out) {
  out.event.push_back(event);
  out.layer.push_back(layer.number);
  out.wire.push_back(wire);
  out.gid.push_back(layer.gid_first + wire);
  out.drift_time.push_back(time);
}

// Runs of neighbouring cells, of which the last is beside the first. Runs may overlap.
void add_runs(const WireLayer& layer, double begins, const Stream& stream, std::int64_t event,
              const CellNoise& noise, NoisyCells& out) {
  Draws draws(stream, Purpose::background_runs, static_cast<std::uint32_t>(layer.number));
  each_fired(draws, layer.cells, begins, [&](int first) {
    const int last = first + run_length(noise.lengths, draws) - 1;
    for (int cell = first; cell <= last; ++cell) {
      const int wire = cell % layer.cells;
      const Block words =
          stream.block(Purpose::background_cell, static_cast<std::uint32_t>(layer.gid_first + wire));
      add_cell(layer, wire, event, noise.window * open_unit(words[0]), out);
    }
  });
}

void add_hot_cells(const Detector& detector, const Stream& stream, std::int64_t event, const CellNoise& noise,
                   NoisyCells& out) {
  for (std::size_t i = 0; i < noise.hot.gid.size(); ++i) {
    const std::int32_t gid = noise.hot.gid[i];
    const Block words = stream.block(Purpose::background_cell, static_cast<std::uint32_t>(gid));
    if (open_unit(words[1]) >= noise.hot.fires[i]) continue;
    const auto layer = std::prev(
        std::upper_bound(detector.wires.begin(), detector.wires.end(), gid,
                         [](std::int32_t number, const WireLayer& one) { return number < one.gid_first; }));
    add_cell(*layer, gid - layer->gid_first, event, noise.window * open_unit(words[2]), out);
  }
}

bool in_dead_area(const MeasuringLayer& layer, double x, double z) {
  const double beside = std::min(x, layer.sheet_width() - x);
  return beside < 0.5 * layer.dead_seam || layer.between_ladders(x) ||
         (layer.dead_ends > 0 && !layer.ends.hold(z, -layer.dead_ends));
}

// Clusters at points of a layer that are uniform in azimuth and z.
void add_clusters(const Detector& detector, std::size_t index, const Stream& stream, const StripNoise& noise,
                  std::vector<std::int32_t>& fired) {
  const MeasuringLayer& layer = detector.layers[index];
  Draws draws(stream, Purpose::background_clusters, static_cast<std::uint32_t>(index));
  const double mean = std::min(noise.clusters[index], 2.0 * most_in_layer);
  for (int n = std::min(poisson(draws.next(), mean), most_in_layer); n > 0; --n) {
    const double around = draws.next() * layer.sheets;
    const int sheet = static_cast<int>(around);
    const double x = (around - sheet) * layer.sheet_width(),
                 z = layer.ends.middle() + (2 * draws.next() - 1) * layer.ends.half();
    const std::array<double, 2> size{draws.next(), draws.next()};
    if (in_dead_area(layer, x, z)) continue;
    const std::array<double, 2> middle{strips_of_x(layer, x), strips_of_v(layer, local_v(layer, x, z))};
    for (std::size_t view = 0; view < 2; ++view) {
      const int strips = 1 + static_cast<int>(size[view] * noise.most_strips);
      const int first = static_cast<int>(std::floor(middle[view] - 0.5 * (strips - 1)));
      const int end = std::min(first + strips, view == 0 ? layer.strips_x : layer.strips_v);
      for (int strip = std::max(first, 0); strip < end; ++strip) {
        fired.push_back(gid_of(layer, sheet, static_cast<int>(view), strip));
      }
    }
  }
}

// Single strips of a layer.
void add_single(const Detector& detector, std::size_t index, const Stream& stream, const StripNoise& noise,
                std::vector<std::int32_t>& fired) {
  const MeasuringLayer& layer = detector.layers[index];
  for (int sheet = 0; sheet < layer.sheets; ++sheet) {
    for (int view = 0; view < 2; ++view) {
      const int first = gid_of(layer, sheet, view, 0);
      Draws draws(stream, Purpose::background_noise, static_cast<std::uint32_t>(first));
      each_fired(draws, view == 0 ? layer.strips_x : layer.strips_v,
                 noise.single[2 * index + static_cast<std::size_t>(view)],
                 [&](int strip) { fired.push_back(first + strip); });
    }
  }
}

// `charge`: its range.
void add_strip(const Detector& detector, std::int32_t gid, std::int64_t event, const Stream& stream,
               const std::array<double, 2>& charge, double window, NoisyStrips& out) {
  const auto layer = std::prev(std::upper_bound(
      detector.layers.begin(), detector.layers.end(), gid,
      [](std::int32_t number, const MeasuringLayer& one) { return number < one.gid_first; }));
  const int per_sheet = layer->strips_x + layer->strips_v;
  const int in_layer = gid - layer->gid_first, in_sheet = in_layer % per_sheet;
  const bool is_v = in_sheet >= layer->strips_x;
  const Block words = stream.block(Purpose::background_strip, static_cast<std::uint32_t>(gid));
  out.event.push_back(event);
  out.layer.push_back(static_cast<std::int32_t>(layer - detector.layers.begin()));
  out.sheet.push_back(in_layer / per_sheet);
  out.view.push_back(is_v ? 1 : 0);
  out.strip.push_back(is_v ? in_sheet - layer->strips_x : in_sheet);
  out.gid.push_back(gid);
  out.charge.push_back(charge[0] + (charge[1] - charge[0]) * open_unit(words[0]));
  out.time.push_back(window * open_unit(words[1]));
}

void sort_once(std::vector<std::int32_t>& gids) {
  std::sort(gids.begin(), gids.end());
  gids.erase(std::unique(gids.begin(), gids.end()), gids.end());
}

}  // namespace

NoisyCells background_cells(const Detector& detector, std::span<const std::int64_t> events,
                            const CellNoise& noise) {
  NoisyCells out;
  for (const std::int64_t event : events) {
    const Stream stream = stream_of(noise.seed, event);
    for (std::size_t i = 0; i < detector.wires.size(); ++i) {
      add_runs(detector.wires[i], noise.begins[i], stream, event, noise, out);
    }
    add_hot_cells(detector, stream, event, noise, out);
  }
  return out;
}

NoisyStrips background_strips(const Detector& detector, std::span<const std::int64_t> events,
                              const StripNoise& noise) {
  NoisyStrips out;
  std::vector<std::int32_t> in_clusters, alone, fired;
  for (const std::int64_t event : events) {
    const Stream stream = stream_of(noise.seed, event);
    in_clusters.clear();
    alone.clear();
    for (std::size_t i = 0; i < detector.layers.size(); ++i) {
      add_clusters(detector, i, stream, noise, in_clusters);
      add_single(detector, i, stream, noise, alone);
    }
    for (std::size_t i = 0; i < noise.hot.gid.size(); ++i) {
      const auto place = static_cast<std::uint32_t>(noise.hot.gid[i]);
      const Block words = stream.block(Purpose::background_strip, place);
      if (open_unit(words[2]) < noise.hot.fires[i]) alone.push_back(noise.hot.gid[i]);
    }
    sort_once(in_clusters);
    sort_once(alone);
    fired.clear();
    std::ranges::set_union(in_clusters, alone, std::back_inserter(fired));
    for (const std::int32_t gid : fired) {
      const bool is_noise = !std::ranges::binary_search(in_clusters, gid);
      add_strip(detector, gid, event, stream, is_noise ? noise.noise : noise.charge, noise.window, out);
    }
  }
  return out;
}

ChannelOrder by_channel(std::span<const std::int64_t> event, std::span<const std::int32_t> gid,
                        std::span<const double> time) {
  struct Row {
    std::int64_t event;
    std::int32_t gid;
    double time;
    std::int64_t number;
  };
  std::vector<Row> rows(event.size());
  for (std::size_t i = 0; i < rows.size(); ++i) {
    rows[i] = {event[i], gid[i], time[i], static_cast<std::int64_t>(i)};
  }
  std::sort(rows.begin(), rows.end(), [](const Row& a, const Row& b) {
    return std::tie(a.event, a.gid, a.time, a.number) < std::tie(b.event, b.gid, b.time, b.number);
  });
  ChannelOrder out;
  out.rows.reserve(rows.size());
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const bool again = i > 0 && rows[i].event == rows[i - 1].event && rows[i].gid == rows[i - 1].gid;
    if (!again) out.first.push_back(static_cast<std::int64_t>(i));
    out.rows.push_back(rows[i].number);
  }
  return out;
}

}  // namespace cgemit

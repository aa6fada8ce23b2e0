#include "simulation/digitize/wires.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <tuple>

#include "common/lanes/number.hpp"
#include "common/lanes/philox.hpp"
#include "detector/wires.hpp"

namespace cgemit {
namespace {

struct FiredCell {
  std::int32_t gid;
  double drift, sigma, drift_time, arrival;  // arrival: ns, delay included
  std::size_t row;

  bool operator<(const FiredCell& other) const {
    if (gid != other.gid) return gid < other.gid;
    return std::tuple(arrival, drift, row) < std::tuple(other.arrival, other.drift, other.row);
  }
};

// Index in the detector of each layer number of the experiment; -1 if there is no such layer.
std::vector<int> index_of_number(const Detector& detector) {
  std::vector<int> index;
  for (std::size_t i = 0; i < detector.wires.size(); ++i) {
    const auto number = static_cast<std::size_t>(detector.wires[i].number);
    if (number >= index.size()) index.resize(number + 1, -1);
    index[number] = static_cast<int>(i);
  }
  return index;
}

void check(const WireTruthColumns& truths, const Detector& detector, const std::vector<int>& index) {
  const auto fail = [](std::size_t row, const std::string& what) {
    throw std::invalid_argument("wire_truths row " + std::to_string(row) + ": " + what);
  };
  for (std::size_t i = 0; i < truths.size(); ++i) {
    const auto number = truths.layer[i];
    if (number < 0 || static_cast<std::size_t>(number) >= index.size() || index[number] < 0) {
      fail(i, "the detector has no wire layer " + std::to_string(number));
    }
    const int cells = detector.wires[index[number]].cells;
    if (truths.wire[i] < 0 || truths.wire[i] >= cells) {
      fail(i, "wire " + std::to_string(truths.wire[i]) + ", expected 0 to " + std::to_string(cells - 1));
    }
    if (!std::isfinite(truths.doca[i])) fail(i, "doca is not finite");
    if (!std::isfinite(truths.delay[i])) fail(i, "time is not finite");
  }
}

// Time against drift distance: linear between the points of a relation, and beyond the outermost ones.
class DriftTimes {
 public:
  explicit DriftTimes(const std::vector<DriftPoint>& points) {
    for (std::size_t k = 0; k + 1 < points.size(); ++k) {
      const DriftPoint &from = points[k], &to = points[k + 1];
      parts_.push_back({from.distance, from.time, (to.time - from.time) / (to.distance - from.distance)});
    }
  }

  template <class T>
  T operator()(const T& drift) const {
    // Looking at all parts has no branches.
    T from = parts_[0].from, time = parts_[0].time, slope = parts_[0].slope;
    for (const Part& part : parts_) {
      const mask_of<T> beyond = drift >= part.from;
      from = select(beyond, T(part.from), from);
      time = select(beyond, T(part.time), time);
      slope = select(beyond, T(part.slope), slope);
    }
    return time + slope * (drift - from);
  }

 private:
  struct Part {
    double from, time, slope;
  };
  std::vector<Part> parts_;
};

// Those of all layers; most detectors have one relation.
class DriftTimesOfLayers {
 public:
  explicit DriftTimesOfLayers(const std::vector<WireLayer>& layers) {
    for (std::size_t i = 0; i < layers.size(); ++i) {
      one_ = one_ && layers[i].relation == layers[0].relation;
      of_layer_.emplace_back(layers[i].relation);
    }
  }

  // `layer`: the layer of a lane.
  template <class Layer>
  Number operator()(const Number& drift, Layer&& layer) const {
    if (one_) return of_layer_[0](drift);
    return gathered<Number>([&](int i) { return of_layer_[layer(i)](lane(drift, i)); });
  }

 private:
  std::vector<DriftTimes> of_layer_;
  bool one_ = true;
};

// Adds the cells of some rows that fire, at most as many as there are lanes.
void fire(const Detector& detector, const std::vector<int>& index, const WireTruthColumns& truths,
          std::size_t first, std::size_t n, const WireReadout& readout, const DriftTimesOfLayers& times,
          std::vector<FiredCell>& out) {
  BlockSeries<Number> draws;
  Number distance, least, slope, efficiency;
  bool straight = true;
  const auto layer_of = [&](int i) {
    const std::size_t row = first + std::min(static_cast<std::size_t>(i), n - 1);
    return static_cast<std::size_t>(index[truths.layer[row]]);
  };
  for (int i = 0; i < lanes_of<Number>; ++i) {
    const std::size_t row = first + std::min(static_cast<std::size_t>(i), n - 1);
    const WireLayer& layer = detector.wires[layer_of(i)];
    const Stream stream(readout.seed, static_cast<std::uint64_t>(truths.event[row]),
                        static_cast<std::uint32_t>(truths.particle[row]));
    draws.set(i, stream, Purpose::drift_distance,
              static_cast<std::uint32_t>(layer.number) << 16 | static_cast<std::uint32_t>(truths.wire[row]));
    set_lane(distance, i, std::abs(truths.doca[row]));
    set_lane(least, i, layer.sigma);
    set_lane(slope, i, layer.sigma_slope);
    set_lane(efficiency, i, layer.efficiency);
    straight = straight && layer.ramps.empty();
  }
  const auto sigma_at = [&](const Number& where) {
    if (straight) return least + slope * larger(where, 0.0);
    return gathered<Number>(
        [&](int i) { return drift_error(detector.wires[layer_of(i)], std::max(lane(where, i), 0.0)); });
  };
  const BlockOf<Number> words = draws.next();
  const Number drift = distance + sigma_at(distance) * normal_quantile(open_unit(words[0]));
  // The error is evaluated at the measured drift distance, the only one that the hit has.
  const Number sigma = sigma_at(drift), time = times(drift, layer_of);
  each_lane(open_unit(words[1]) <= efficiency, [&](int i) {
    const std::size_t row = first + static_cast<std::size_t>(i);
    if (row >= first + n) return;
    const std::int32_t gid = detector.wires[index[truths.layer[row]]].gid_first + truths.wire[row];
    out.push_back(
        {gid, lane(drift, i), lane(sigma, i), lane(time, i), lane(time, i) + truths.delay[row], row});
  });
}

}  // namespace

Columns<WireHitRow> read_out_wires(const Detector& detector, const WireTruthColumns& truths,
                                   const WireReadout& readout) {
  const auto index = index_of_number(detector);
  check(truths, detector, index);
  Columns<WireHitRow> hits;
  hits.reserve(truths.size());
  constexpr std::size_t lanes = lanes_of<Number>;
  const DriftTimesOfLayers times(detector.wires);
  std::vector<FiredCell> fired;
  for (std::size_t begin = 0, end; begin < truths.size(); begin = end) {
    fired.clear();
    for (end = begin; end < truths.size() && truths.event[end] == truths.event[begin];) ++end;
    for (std::size_t row = begin; row < end; row += lanes)
      fire(detector, index, truths, row, std::min(lanes, end - row), readout, times, fired);
    if (!std::ranges::is_sorted(fired, std::less<>())) std::sort(fired.begin(), fired.end());
    for (std::size_t i = 0; i < fired.size(); ++i) {
      const FiredCell& cell = fired[i];
      if (i > 0 && cell.gid == fired[i - 1].gid) continue;
      hits.push_back({truths.event[cell.row], truths.layer[cell.row], truths.wire[cell.row], cell.gid,
                      cell.drift, cell.sigma, cell.drift_time,
                      readout.reveal_sides ? truths.side[cell.row] : std::int8_t{0},
                      static_cast<std::int64_t>(cell.row)});
    }
  }
  return hits;
}

}  // namespace cgemit

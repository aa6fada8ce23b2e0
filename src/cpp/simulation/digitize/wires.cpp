#include "simulation/digitize/wires.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <tuple>

#include "common/rng.hpp"

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

// Linear interpolation between the points of the table, and extrapolation beyond the outermost ones.
double drift_time(const WireReadout& readout, double drift) {
  const auto& x = readout.xt_distance;
  // Counting the points up to there has no branches: a search among ten points takes twice as long.
  std::size_t above = 1;
  for (std::size_t k = 1; k + 1 < x.size(); ++k) above += x[k] <= drift;
  const double share = (drift - x[above - 1]) / (x[above] - x[above - 1]);
  return readout.xt_time[above - 1] + share * (readout.xt_time[above] - readout.xt_time[above - 1]);
}

void fire(const WireLayer& layer, const WireTruthColumns& truths, std::size_t row, const WireReadout& readout,
          std::vector<FiredCell>& out) {
  const Stream stream(readout.seed, static_cast<std::uint64_t>(truths.event[row]),
                      static_cast<std::uint32_t>(truths.particle[row]));
  const auto place =
      static_cast<std::uint32_t>(layer.number) << 16 | static_cast<std::uint32_t>(truths.wire[row]);
  const Block words = stream.block(Purpose::drift_distance, place);
  if (open_unit(words[1]) > layer.efficiency) return;
  const auto sigma = [&](double distance) {
    return layer.sigma + layer.sigma_slope * std::max(0.0, distance);
  };
  const double distance = std::abs(truths.doca[row]);
  const double drift = distance + sigma(distance) * normal_quantile(open_unit(words[0]));
  const double time = drift_time(readout, drift);
  // The error is evaluated at the measured drift distance, the only one that the hit has.
  out.push_back(
      {layer.gid_first + truths.wire[row], drift, sigma(drift), time, time + truths.delay[row], row});
}

void write(const WireTruthColumns& truths, bool reveal_sides, const FiredCell& hit, WireHitColumns& hits) {
  hits.event.push_back(truths.event[hit.row]);
  hits.layer.push_back(truths.layer[hit.row]);
  hits.wire.push_back(truths.wire[hit.row]);
  hits.gid.push_back(hit.gid);
  hits.drift.push_back(hit.drift);
  hits.sigma.push_back(hit.sigma);
  hits.drift_time.push_back(hit.drift_time);
  hits.side.push_back(reveal_sides ? truths.side[hit.row] : std::int8_t{0});
  hits.wire_truth.push_back(static_cast<std::int64_t>(hit.row));
}

void reserve(WireHitColumns& hits, std::size_t n) {
  for (auto* values : {&hits.event, &hits.wire_truth}) values->reserve(n);
  for (auto* values : {&hits.layer, &hits.wire, &hits.gid}) values->reserve(n);
  for (auto* values : {&hits.drift, &hits.sigma, &hits.drift_time}) values->reserve(n);
  hits.side.reserve(n);
}

}  // namespace

WireHitColumns read_out_wires(const Detector& detector, const WireTruthColumns& truths,
                              const WireReadout& readout) {
  const auto index = index_of_number(detector);
  check(truths, detector, index);
  WireHitColumns hits;
  reserve(hits, truths.size());
  std::vector<FiredCell> fired;
  for (std::size_t begin = 0, end; begin < truths.size(); begin = end) {
    fired.clear();
    for (end = begin; end < truths.size() && truths.event[end] == truths.event[begin]; ++end) {
      fire(detector.wires[index[truths.layer[end]]], truths, end, readout, fired);
    }
    std::sort(fired.begin(), fired.end());
    for (std::size_t i = 0; i < fired.size(); ++i) {
      if (i == 0 || fired[i].gid != fired[i - 1].gid) write(truths, readout.reveal_sides, fired[i], hits);
    }
  }
  return hits;
}

}  // namespace cgemit

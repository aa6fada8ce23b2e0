// The columns of the truths and steps tables that the digitizers read.
#pragma once

#include <cmath>
#include <cstdint>
#include <span>
#include <stdexcept>
#include <string>
#include <tuple>

#include "common/columns.hpp"
#include "detector/detector.hpp"
#include "simulation/digitize/strips.hpp"

namespace cgemit {

struct TruthColumns {
  std::span<const std::int64_t> event;
  std::span<const std::int32_t> particle, layer;
  std::array<std::span<const double>, 3> entry, exit;  // x, y, z in mm
  std::span<const double> phi, z;                      // rad, mm; at mid-gap
  std::span<const double> time, energy;                // ns, keV

  std::size_t size() const { return event.size(); }
  Point entry_point(std::size_t i) const { return {entry[0][i], entry[1][i], entry[2][i]}; }
  Point exit_point(std::size_t i) const { return {exit[0][i], exit[1][i], exit[2][i]}; }

  static constexpr auto columns() {
    return std::tuple(Column("event", &TruthColumns::event), Column("particle", &TruthColumns::particle),
                      Column("layer", &TruthColumns::layer), Column("entry_", &TruthColumns::entry),
                      Column("exit_", &TruthColumns::exit), Column("phi", &TruthColumns::phi),
                      Column("z", &TruthColumns::z), Column("time", &TruthColumns::time),
                      Column("energy", &TruthColumns::energy));
  }
};

// Columns of the steps table. A step is the straight piece from middle - d/2 to middle + d/2.
struct StepColumns {
  std::span<const std::int64_t> event, truth;  // truth: row of the truths
  std::span<const std::int32_t> particle, layer, n_electrons;
  std::span<const std::int8_t> parent;               // 0 the particle itself, 1 a delta electron
  std::array<std::span<const double>, 3> middle, d;  // x, y, z in mm
  std::span<const double> energy;                    // keV

  std::size_t size() const { return event.size(); }
  bool is_delta(std::size_t i) const { return parent[i] != 0; }
  Point end(std::size_t i, double side) const {
    return {middle[0][i] + side * d[0][i], middle[1][i] + side * d[1][i], middle[2][i] + side * d[2][i]};
  }

  static constexpr auto columns() {
    return std::tuple(Column("event", &StepColumns::event), Column("truth", &StepColumns::truth),
                      Column("particle", &StepColumns::particle), Column("layer", &StepColumns::layer),
                      Column("n_electrons", &StepColumns::n_electrons),
                      Column("parent", &StepColumns::parent), Column("", &StepColumns::middle),
                      Column("d", &StepColumns::d), Column("energy", &StepColumns::energy));
  }
};

// End of the rows of the same event as row `begin`.
inline std::size_t event_end(std::span<const std::int64_t> event, std::size_t begin) {
  std::size_t end = begin + 1;
  while (end < event.size() && event[end] == event[begin]) ++end;
  return end;
}

// Number of earlier rows of the event with the same particle in the same layer; with particle and layer it
// identifies a truth independently of the chunk.
inline std::uint32_t earlier(const TruthColumns& truths, std::size_t event_begin, std::size_t row) {
  std::uint32_t n = 0;
  for (std::size_t i = event_begin; i < row; ++i) {
    n += truths.particle[i] == truths.particle[row] && truths.layer[i] == truths.layer[row];
  }
  return n;
}

// Throws std::invalid_argument, naming the first row with values that the kernels cannot handle.
inline void check(const TruthColumns& truths, const Detector& detector) {
  const auto layers = static_cast<std::int32_t>(detector.layers.size());
  for (std::size_t i = 0; i < truths.size(); ++i) {
    if (truths.layer[i] < 0 || truths.layer[i] >= layers) {
      throw std::invalid_argument("truths row " + std::to_string(i) + ": layer " +
                                  std::to_string(truths.layer[i]) + ", expected 0 to " +
                                  std::to_string(layers - 1));
    }
    double sum = truths.phi[i] + truths.z[i] + truths.time[i] + truths.energy[i];
    for (std::size_t k = 0; k < 3; ++k) sum += truths.entry[k][i] + truths.exit[k][i];
    if (!std::isfinite(sum)) {
      throw std::invalid_argument("truths row " + std::to_string(i) + ": a value is not finite");
    }
  }
}

// Whether the middle of a step of a delta electron lies in the drift gap. A chord between two points of the
// inner face lies below it by its sagitta, so the mean square radius of the end points is compared. Clusters
// of the particle itself are on the chord from entry to exit and have no effect.
inline bool in_gap(const StepColumns& steps, std::size_t i, const MeasuringLayer& layer) {
  constexpr double rounding = 1e-3;  // mm
  const double x = steps.middle[0][i], y = steps.middle[1][i], dx = steps.d[0][i], dy = steps.d[1][i];
  const double low = layer.r_gap_in - rounding, high = layer.r_gap_out + rounding;
  const double square = x * x + y * y;
  return square <= high * high && square + 0.25 * (dx * dx + dy * dy) >= low * low;
}

// Throws std::invalid_argument, naming the first row that does not belong to its truth, or has impossible
// values. Steps come in the order of the truths, which have been checked.
inline void check(const StepColumns& steps, const TruthColumns& truths, const Detector& detector) {
  std::int64_t before = 0;
  for (std::size_t i = 0; i < steps.size(); ++i) {
    const auto fail = [i](const std::string& problem) {
      throw std::invalid_argument("steps row " + std::to_string(i) + ": " + problem);
    };
    const std::int64_t truth = steps.truth[i];
    if (truth < before || truth >= static_cast<std::int64_t>(truths.size())) {
      fail("truth " + std::to_string(truth) + ", expected " + std::to_string(before) + " to " +
           std::to_string(static_cast<std::int64_t>(truths.size()) - 1));
    }
    const auto row = static_cast<std::size_t>(truth);
    if (steps.event[i] != truths.event[row] || steps.layer[i] != truths.layer[row] ||
        steps.particle[i] != truths.particle[row]) {
      fail("event, particle and layer are not those of its truth, row " + std::to_string(truth));
    }
    if (steps.parent[i] != 0 && steps.parent[i] != 1) {
      fail("parent " + std::to_string(steps.parent[i]) + ", expected 0 or 1");
    }
    constexpr std::int32_t most_electrons = 1'000'000;
    if (steps.n_electrons[i] < 0 || steps.n_electrons[i] > most_electrons) {
      fail("n_electrons " + std::to_string(steps.n_electrons[i]) + ", expected 0 to " +
           std::to_string(most_electrons));
    }
    double sum = steps.energy[i];
    for (std::size_t k = 0; k < 3; ++k) sum += steps.middle[k][i] + steps.d[k][i];
    if (!std::isfinite(sum) || steps.energy[i] < 0) fail("a value is not finite, or the energy negative");
    const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(steps.layer[i])];
    if (steps.is_delta(i) && !in_gap(steps, i, layer)) {
      fail("radius " + std::to_string(std::hypot(steps.middle[0][i], steps.middle[1][i])) + " mm, expected " +
           std::to_string(layer.r_gap_in) + " to " + std::to_string(layer.r_gap_out) +
           " mm, the drift gap of its layer");
    }
    before = truth;
  }
}

}  // namespace cgemit

#include "simulation/digitize/gaussian.hpp"

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>

#include "common/angles.hpp"
#include "common/rng.hpp"
#include "detector/strip_plane.hpp"

namespace cgemit {
namespace {

// The X and V rows of one truth.
struct Pair {
  DigiRow x, v;
};

// Errors of X and V at the inclination of a crossing.
std::pair<double, double> inclined(const MeasuringLayer& layer, const PositionErrors& errors, int sheet,
                                   const Point& entry, const Point& exit) {
  if (layer.slope == 0) return {errors.sigma_x, errors.sigma_v};
  const double from = local_x(layer, sheet, std::atan2(entry.y, entry.x));
  // Entry and exit may lie on both sides of the edge of the sheet.
  const double to = from + layer.r_readout * turn_between(entry.x, entry.y, exit.x, exit.y);
  const double along_v = local_v(layer, to, exit.z) - local_v(layer, from, entry.z);
  return {std::hypot(errors.sigma_x, layer.slope * (to - from)),
          std::hypot(errors.sigma_v, layer.slope * along_v)};
}

std::optional<Pair> smear(const Detector& detector, const TruthColumns& truths, std::size_t event_begin,
                          std::size_t row, const GaussianReadout& readout) {
  const auto index = static_cast<std::size_t>(truths.layer[row]);
  const MeasuringLayer& layer = detector.layers[index];
  const PositionErrors& errors = readout.errors[index];
  if (layer.ends.miss(truths.z[row])) return std::nullopt;
  const double per_energy = charge_per_energy(readout.gain, readout.w_values[index]);
  for (int sheet = 0; sheet < layer.sheets; ++sheet) {
    const double x = local_x(layer, sheet, truths.phi[row]);
    if (x >= layer.sheet_width()) continue;
    const Stream stream(readout.seed, static_cast<std::uint64_t>(truths.event[row]),
                        static_cast<std::uint32_t>(truths.particle[row]));
    const auto place = static_cast<std::uint32_t>(truths.layer[row]);
    const Block words = stream.block(Purpose::digitization, place, earlier(truths, event_begin, row));
    DigiRow common{truths.event[row], truths.layer[row], sheet, 0};
    common.charge = 0.5 * truths.energy[row] * per_energy;
    common.time = truths.time[row] + errors.sigma_time * normal_quantile(open_unit(words[3]));
    common.truth = static_cast<std::int64_t>(row);
    common.n_truths = 1;
    Pair pair{common, common};
    const auto [sigma_x, sigma_v] =
        inclined(layer, errors, sheet, truths.entry_point(row), truths.exit_point(row));
    const double shift_x = layer.lorentz_shift, shift_v = shift_x * layer.cos_stereo;
    pair.x.position = errors.sigma_x > 0
                          ? x + shift_x + sigma_x * normal_quantile(open_unit(words[0]))
                          : x_of_strips(layer, std::floor(strips_of_x(layer, x + shift_x)) + 0.5);
    pair.v.view = 1;
    const double v = local_v(layer, x, truths.z[row]);
    pair.v.position = errors.sigma_v > 0
                          ? v + shift_v + sigma_v * normal_quantile(open_unit(words[1]))
                          : v_of_strips(layer, std::floor(strips_of_v(layer, v + shift_v)) + 0.5);
    return pair;
  }
  return std::nullopt;
}

}  // namespace

Columns<DigiRow> smear_positions(const Detector& detector, const TruthColumns& truths,
                                 const GaussianReadout& readout) {
  check(truths, detector);
  Columns<DigiRow> digis;
  std::vector<Pair> pairs;
  for (std::size_t begin = 0, end; begin < truths.size(); begin = end) {
    end = event_end(truths.event, begin);
    pairs.clear();
    for (std::size_t row = begin; row < end; ++row) {
      if (const auto pair = smear(detector, truths, begin, row, readout)) pairs.push_back(*pair);
    }
    const auto sheet_of = [](const Pair& p) { return std::pair(p.x.layer, p.x.sheet); };
    std::stable_sort(pairs.begin(), pairs.end(),
                     [&](const Pair& a, const Pair& b) { return sheet_of(a) < sheet_of(b); });
    for (auto first = pairs.begin(); first != pairs.end();) {
      const auto last =
          std::find_if(first, pairs.end(), [&](const Pair& p) { return sheet_of(p) != sheet_of(*first); });
      const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(first->x.layer)];
      for (auto pair = first; layer.has_x && pair != last; ++pair) digis.push_back(pair->x);
      for (auto pair = first; layer.has_v && pair != last; ++pair) digis.push_back(pair->v);
      first = last;
    }
  }
  return digis;
}

}  // namespace cgemit

#include "simulation/digitize/gaussian.hpp"

#include <algorithm>
#include <optional>
#include <utility>

#include "common/rng.hpp"
#include "detector/strip_plane.hpp"

namespace cgemit {
namespace {

// The X and V rows of one truth.
struct Pair {
  DigiRow x, v;
};

// Number of earlier rows of the event with the same particle in the same layer (a track that comes back).
// Together with particle and layer it identifies a truth independently of the chunk.
std::uint32_t occurrence(const TruthColumns& truths, std::size_t event_begin, std::size_t row) {
  std::uint32_t n = 0;
  for (std::size_t i = event_begin; i < row; ++i) {
    n += truths.particle[i] == truths.particle[row] && truths.layer[i] == truths.layer[row];
  }
  return n;
}

std::optional<Pair> smear(const Detector& detector, const TruthColumns& truths, std::size_t event_begin,
                          std::size_t row, const GaussianReadout& readout) {
  const CgemLayer& layer = detector.cgem[static_cast<std::size_t>(truths.layer[row])];
  if (std::abs(truths.z[row]) > layer.half_length) return std::nullopt;
  const double per_energy =
      charge_per_energy(readout.gain, readout.w_values[static_cast<std::size_t>(truths.layer[row])]);
  for (int sheet = 0; sheet < layer.sheets; ++sheet) {
    const double x = local_x(layer, sheet, truths.phi[row]);
    if (x >= layer.sheet_width()) continue;
    const Stream stream(readout.seed, static_cast<std::uint64_t>(truths.event[row]),
                        static_cast<std::uint32_t>(truths.particle[row]));
    const Block words = stream.block(Purpose::digitization, static_cast<std::uint32_t>(truths.layer[row]),
                                     occurrence(truths, event_begin, row));
    DigiRow common{truths.event[row], truths.layer[row], sheet, 0};
    common.charge = 0.5 * truths.energy[row] * per_energy;
    common.time = truths.time[row];
    common.truth = static_cast<std::int64_t>(row);
    common.n_truths = 1;
    Pair pair{common, common};
    pair.x.position = x + readout.sigma_x * normal_quantile(open_unit(words[0]));
    pair.v.view = 1;
    pair.v.position =
        local_v(layer, x, truths.z[row]) + readout.sigma_v * normal_quantile(open_unit(words[1]));
    return pair;
  }
  return std::nullopt;
}

}  // namespace

DigiColumns smear_positions(const Detector& detector, const TruthColumns& truths,
                            const GaussianReadout& readout) {
  check(truths, detector);
  DigiColumns digis;
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
      for (auto pair = first; pair != last; ++pair) digis.push_back(pair->x);
      for (auto pair = first; pair != last; ++pair) digis.push_back(pair->v);
      first = last;
    }
  }
  return digis;
}

}  // namespace cgemit

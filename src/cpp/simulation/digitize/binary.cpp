#include "simulation/digitize/binary.hpp"

#include <stdexcept>
#include <string>

#include "simulation/digitize/contributions.hpp"

namespace cgemit {
namespace {

constexpr double rounding = 1e-9;  // of an energy that was summed in another order

// Strips that one truth fires on one sheet.
struct Fired {
  int sheet;
  StripRange x, v;
};

// Shares `charge` among the strips that the projected segment touches; charge off the active area is lost.
void share(const MeasuringLayer& layer, const Point& from, const Point& to, double charge, Contribution strip,
           Contributions& out) {
  const Pieces pieces = unroll(layer, from, to);
  std::array<Fired, most_sheets + 1> fired;
  int n_x = 0, n_v = 0;
  for (int k = 0; k < pieces.n; ++k) {
    const SheetPiece& piece = pieces.list[k];
    fired[k] = {piece.sheet, x_strips(layer, piece), v_strips(layer, piece)};
    n_x += fired[k].x.count();
    n_v += fired[k].v.count();
  }
  for (int k = 0; k < pieces.n; ++k) {
    strip.sheet = fired[k].sheet;
    strip.view = 0;
    strip.charge = 0.5 * charge / n_x;
    out.add(layer, strip, fired[k].x);
    strip.view = 1;
    strip.charge = 0.5 * charge / n_v;
    out.add(layer, strip, fired[k].v);
  }
}

// Reads out one truth with its steps [begin, end).
void read_out(const MeasuringLayer& layer, const TruthColumns& truths, std::size_t row,
              const StepColumns& steps, std::size_t begin, std::size_t end, double per_energy,
              Contributions& out) {
  Contribution strip{};
  strip.layer = truths.layer[row];
  strip.time = truths.time[row];
  strip.truth = static_cast<std::int64_t>(row);
  double of_particle = truths.energy[row];
  for (std::size_t i = begin; i < end; ++i) {
    if (!steps.is_delta(i)) continue;
    of_particle -= steps.energy[i];
    share(layer, steps.end(i, -0.5), steps.end(i, 0.5), steps.energy[i] * per_energy, strip, out);
  }
  if (of_particle < -rounding * truths.energy[row]) {
    throw std::invalid_argument("truths row " + std::to_string(row) + ": its delta electrons deposit " +
                                std::to_string(-of_particle) + " keV more than its energy");
  }
  share(layer, truths.entry_point(row), truths.exit_point(row), std::max(0.0, of_particle) * per_energy,
        strip, out);
}

}  // namespace

Columns<DigiRow> read_out_strips(const Detector& detector, const TruthColumns& truths,
                                 const StepColumns& steps, const BinaryReadout& readout,
                                 const GainMaps& gains) {
  check(truths, detector);
  check(steps, truths, detector);
  Columns<DigiRow> digis;
  digis.reserve(8 * truths.size());
  Contributions parts;
  std::size_t step = 0;  // truths and steps have the same order
  for (std::size_t begin = 0, end; begin < truths.size(); begin = end) {
    end = event_end(truths.event, begin);
    parts.clear();
    for (std::size_t row = begin; row < end; ++row) {
      const std::size_t first = step;
      while (step < steps.size() && steps.truth[step] == static_cast<std::int64_t>(row)) ++step;
      const auto layer = static_cast<std::size_t>(truths.layer[row]);
      const double per_energy = charge_per_energy(readout.gain, readout.w_values[layer]) *
                                gains.at(detector, layer, truths.phi[row], truths.z[row]);
      if (truths.energy[row] * per_energy < readout.threshold) continue;
      read_out(detector.layers[layer], truths, row, steps, first, step, per_energy, parts);
    }
    parts.write(truths.event[begin], digis, [](DigiRow&) { return true; });
  }
  return digis;
}

}  // namespace cgemit

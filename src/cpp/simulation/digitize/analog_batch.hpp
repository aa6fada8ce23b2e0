// The analog readout of all events, for one instruction set (kernels/kernels.hpp).
#pragma once

#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "simulation/digitize/analog.hpp"
#include "simulation/digitize/strip_signals.hpp"

namespace cgemit {

// First step of each truth, and the end of the last one's.
inline std::vector<std::size_t> first_steps(const TruthColumns& truths, const StepColumns& steps) {
  std::vector<std::size_t> first(truths.size() + 1, steps.size());
  std::size_t step = 0;
  for (std::size_t row = 0; row < truths.size(); ++row) {
    first[row] = step;
    double deposited = 0;
    for (; step < steps.size() && steps.truth[step] == static_cast<std::int64_t>(row); ++step) {
      deposited += steps.energy[step];
    }
    if (std::abs(deposited - truths.energy[row]) > 1e-6 * (truths.energy[row] + 1)) {
      throw std::invalid_argument("truths row " + std::to_string(row) + ": its steps deposit " +
                                  std::to_string(deposited) + " keV, expected its energy, " +
                                  std::to_string(truths.energy[row]) +
                                  " keV: simulate with SimulateSettings(steps=True)");
    }
  }
  return first;
}

struct CloudWidth {
  double x, z;  // mm
};

// Adds the currents of a cloud at (phi, z) with a charge (fC) for each view. Outside of the active area it is
// lost.
template <class T>
void induce_on_layer(const MeasuringLayer& layer, double phi, double z, CloudWidth width,
                     const std::array<double, 2>& charge, const typename StripSignals<T>::Transit& at,
                     StripSignals<T>& signals) {
  constexpr double reach = 6, least = 1e-6;  // widths; mm, of a cloud without diffusion
  const double sigma_x = std::max(width.x, least), sigma_z = std::max(width.z, least);
  const double in_z = part_within(z, sigma_z, layer.ends.low, layer.ends.high);
  if (in_z <= 0) return;
  for (int sheet = 0; sheet < layer.sheets; ++sheet) {
    double x = local_x(layer, sheet, phi);
    if (x > layer.sheet_width() + reach * sigma_x) x -= 2 * pi * layer.r_readout;
    if (x < -reach * sigma_x) continue;
    signals.add(sheet, 0, strips_of_x(layer, x), in_z * charge[0], at);
    const double v = strips_of_v(layer, local_v(layer, x, z));
    if (in_z < 1 || part_within(x, sigma_x, 0, layer.sheet_width()) < 1) {
      std::vector<double> parts(signals.strips());
      parts_on_sheet(layer, x, z, sigma_x, sigma_z, signals.first_strip(v), parts);
      signals.add(sheet, 1, v, charge[1], at, parts);
    } else {
      signals.add(sheet, 1, v, charge[1], at);
    }
  }
}

// Reads out events one after the other, with electrons of one truth side by side in the lanes of T.
template <class T>
class EventReadout {
 public:
  EventReadout(const Detector& detector, const TruthColumns& truths, const StepColumns& steps,
               const AnalogModel& readout, const GainMaps& gains)
      : detector_(detector),
        truths_(truths),
        steps_(steps),
        first_(first_steps(truths, steps)),
        readout_(readout),
        gains_(gains),
        response_(std::visit([](const auto& one) { return one.response(); }, readout.chip)),
        noise_(std::visit([](const auto& one) { return one.amplifier.noise; }, readout.chip)) {
    for (std::size_t layer = 0; layer < detector.layers.size(); ++layer) {
      signals_.emplace_back(detector.layers[layer], layer, detector.layers.size(), readout.induced,
                            readout.drift[layer].induction);
    }
  }

  // Truths [begin, end) are those of one event.
  void read(std::size_t begin, std::size_t end) {
    for (std::size_t layer = 0; layer < detector_.layers.size(); ++layer) {
      if (!open(layer, begin, end)) continue;
      for (std::size_t row = begin; row < end; ++row) {
        if (truths_.layer[row] != static_cast<std::int32_t>(layer)) continue;
        collect(row, begin);
        signals_[layer].close(static_cast<std::int64_t>(row));
      }
      write(layer, truths_.event[begin]);
    }
  }
  Columns<DigiRow> digis;

 private:
  static constexpr std::size_t width = lanes_of<T>;
  static constexpr double late = 8;  // widths of the drift time beyond which no electron arrives
  // Electrons of one truth, in order, with the step that each comes from.
  struct Group {
    std::array<std::size_t, width> step{};
    std::size_t n = 0;
  };

  // Prepares the currents of a layer; false if no truth crosses it.
  bool open(std::size_t layer, std::size_t begin, std::size_t end) {
    double first = std::numeric_limits<double>::infinity(), last = -first;
    for (std::size_t row = begin; row < end; ++row) {
      if (truths_.layer[row] != static_cast<std::int32_t>(layer)) continue;
      first = std::min(first, truths_.time[row]);
      last = std::max(last, truths_.time[row]);
    }
    if (first > last) return false;
    const LayerDrift& drift = readout_.drift[layer];
    const double gap = detector_.layers[layer].r_gap_out - detector_.layers[layer].r_gap_in;
    const double spread = late * readout_.physics.diffusion * drift.sigma_l * std::sqrt(gap) / drift.velocity;
    signals_[layer].begin(first + drift.delay - spread, last + drift.delay + gap / drift.velocity + spread);
    return true;
  }

  // Drifts all electrons of a truth to the strips.
  void collect(std::size_t row, std::size_t event_begin) {
    const auto number = static_cast<std::size_t>(truths_.layer[row]);
    const std::uint32_t before = earlier(truths_, event_begin, row);
    const std::uint32_t place = (static_cast<std::uint32_t>(number) << 19) | ((before & 7U) << 16);
    const Stream stream(readout_.seed, static_cast<std::uint64_t>(truths_.event[row]),
                        static_cast<std::uint32_t>(truths_.particle[row]) | ((before & 8U) << 16));
    const double ratio = readout_.share_spread * stream.normals(Purpose::readout_truth, place)[0];
    const std::array<double, 2> share = {1 / (1 + std::exp(-ratio)), 1 / (1 + std::exp(ratio))};
    Group group;
    std::uint32_t electron = 0;
    const auto flush = [&] {
      ElectronDraws<T> draws(stream, place, electron);
      release(number, group, row, share, draws);
      electron += width;
      group.n = 0;
    };
    for (std::size_t i = first_[row]; i < first_[row + 1]; ++i) {
      for (std::int32_t k = 0; k < steps_.n_electrons[i]; ++k) {
        group.step[group.n++] = i;
        if (group.n == width) flush();
      }
    }
    if (group.n > 0) flush();
  }

  // The electrons of a group: their draws, drift and gain side by side, their clouds one after the other.
  void release(std::size_t number, const Group& group, std::size_t row, const std::array<double, 2>& share,
               ElectronDraws<T>& draws) {
    mask_of<T> arrives = draws.uniform() <= T(readout_.physics.survival);
    for (int i = static_cast<int>(group.n); i < lanes_of<T>; ++i) set_lane(arrives, i, false);
    if (!any(arrives)) return;
    const T side = draws.uniform() - 0.5;
    const auto coordinate = [&](std::size_t axis) {
      const auto column = [&](std::span<const double> values) {
        return gathered<T>([&](int i) { return values[group.step[static_cast<std::size_t>(i)]]; });
      };
      return column(steps_.middle[axis]) + side * column(steps_.d[axis]);
    };
    const Arrival<T> clouds = drift(detector_.layers[number], readout_.drift[number], readout_.physics,
                                    coordinate(0), coordinate(1), coordinate(2), draws, arrives);
    each_lane(arrives, [&](int i) {
      induce(number, row, share,
             {lane(clouds.phi, i), lane(clouds.z, i), lane(clouds.time, i), lane(clouds.charge, i)});
    });
  }

  // One avalanche on the strips of both views.
  void induce(std::size_t number, std::size_t row, const std::array<double, 2>& share,
              const Arrival<double>& cloud) {
    const MeasuringLayer& layer = detector_.layers[number];
    const LayerDrift& gas = readout_.drift[number];
    const double factor = readout_.physics.diffusion;
    const CloudWidth cloud_width{layer.r_readout * factor * gas.cloud_phi, factor * gas.cloud_z};
    const double charge =
        cloud.charge * elementary_charge_fC * gains_.at(detector_, number, cloud.phi, cloud.z);
    StripSignals<T>& signals = signals_[number];
    induce_on_layer(layer, cloud.phi, cloud.z, cloud_width, {share[0] * charge, share[1] * charge},
                    signals.transit(truths_.time[row] + cloud.time), signals);
  }

  void write(std::size_t number, std::int64_t event) {
    const MeasuringLayer& layer = detector_.layers[number];
    const Stream stream(readout_.seed, static_cast<std::uint64_t>(event), 0);
    signals_[number].each([&](int sheet, int view, int strip, const auto& source, CurrentSteps steps) {
      DigiRow digi{event, static_cast<std::int32_t>(number), sheet, static_cast<std::int8_t>(view), strip};
      digi.gid = gid_of(layer, sheet, view, strip);
      if (source.total <= noise_) return;
      const Current current{steps, source.total, signals_[number].start()};
      const NormalNoise noise(stream, static_cast<std::uint32_t>(digi.gid));
      const auto measured = std::visit(
          [&](const auto& one) { return one.measure(response_, view, current, noise); }, readout_.chip);
      if (!measured) return;
      digi.charge = measured->charge;
      digi.time = measured->time;
      digi.truth = source.largest_truth;
      digi.n_truths = source.n;
      digis.push_back(digi);
    });
  }

  const Detector& detector_;
  const TruthColumns& truths_;
  const StepColumns& steps_;
  std::vector<std::size_t> first_;
  const AnalogModel& readout_;
  const GainMaps& gains_;
  StepResponse response_;
  double noise_;  // fC
  std::vector<StripSignals<T>> signals_;
};

template <class T>
void read_out_analog_lanes(const Detector& detector, const TruthColumns& truths, const StepColumns& steps,
                           const AnalogModel& readout, const GainMaps& gains, Columns<DigiRow>& digis) {
  check(truths, detector);
  check(steps, truths, detector);
  EventReadout<T> event(detector, truths, steps, readout, gains);
  for (std::size_t begin = 0, end; begin < truths.size() && !readout.interrupted(); begin = end) {
    end = event_end(truths.event, begin);
    event.read(begin, end);
  }
  digis = std::move(event.digis);
}

}  // namespace cgemit

#include "simulation/digitize/projection.hpp"

#include <algorithm>
#include <cmath>

#include "common/rng.hpp"
#include "simulation/digitize/avalanche.hpp"
#include "simulation/digitize/contributions.hpp"

namespace cgemit {

double profile_below(double edge, double a, double b, double sigma) {
  const double length = b - a;
  if (std::abs(length) < 1e-6 * sigma) return below((edge - 0.5 * (a + b)) / sigma);
  const auto integral = [sigma](double u) {
    return u * below(u / sigma) + sigma * 0.39894228040143267794 * std::exp(-0.5 * u * u / (sigma * sigma));
  };
  return (integral(edge - a) - integral(edge - b)) / length;
}

namespace {

// Shares a charge between the strips of a view, with ends and width in strips.
template <class Give>
void share_profile(double from, double to, double sigma, int strips, Give&& give) {
  constexpr double reach = 4;
  const double a = std::min(from, to), b = std::max(from, to);
  const int first = std::max(static_cast<int>(std::floor(a - reach * sigma)), 0);
  const int last = std::min(static_cast<int>(std::floor(b + reach * sigma)), strips - 1);
  double before = profile_below(first, a, b, sigma);
  for (int strip = first; strip <= last; ++strip) {
    const double up_to = profile_below(strip + 1, a, b, sigma);
    give(strip, up_to - before);
    before = up_to;
  }
}

// Shares the charge of a segment, half to each view; its pieces take it in proportion to their lengths.
void share(const MeasuringLayer& layer, const Point& from, const Point& to, double charge, double sigma,
           Contribution strip, Contributions& out) {
  const Pieces pieces = unroll(layer, from, to);
  const double whole = std::hypot(layer.r_readout * turn_between(from.x, from.y, to.x, to.y), to.z - from.z);
  for (int k = 0; k < pieces.n; ++k) {
    const SheetPiece& piece = pieces.list[static_cast<std::size_t>(k)];
    const double part = whole > 0 ? std::hypot(piece.x2 - piece.x1, piece.z2 - piece.z1) / whole : 1.0;
    strip.sheet = piece.sheet;
    const auto give = [&](int number, double share_of_strip) {
      strip.charge = 0.5 * charge * part * share_of_strip;
      if (strip.charge > 0) out.add(layer, strip, {number, number});
    };
    strip.view = 0;
    share_profile(strips_of_x(layer, piece.x1), strips_of_x(layer, piece.x2), sigma / layer.pitch_x,
                  layer.strips_x, give);
    strip.view = 1;
    share_profile(strips_of_v(layer, local_v(layer, piece.x1, piece.z1)),
                  strips_of_v(layer, local_v(layer, piece.x2, piece.z2)), sigma / layer.pitch_v,
                  layer.strips_v, give);
  }
}

}  // namespace

Columns<DigiRow> read_out_profiles(const Detector& detector, const TruthColumns& truths,
                                   const StepColumns& steps, const ProjectionReadout& readout,
                                   const GainMaps& gains) {
  check(truths, detector);
  check(steps, truths, detector);
  Columns<DigiRow> digis;
  Contributions parts;
  std::size_t step = 0;  // truths and steps have the same order
  for (std::size_t begin = 0, end; begin < truths.size(); begin = end) {
    end = event_end(truths.event, begin);
    parts.clear();
    for (std::size_t row = begin; row < end; ++row) {
      const auto number = static_cast<std::size_t>(truths.layer[row]);
      const double per_energy = charge_per_energy(readout.gain, readout.w_values[number]);
      Contribution strip{};
      strip.layer = truths.layer[row];
      strip.time = truths.time[row];
      strip.truth = static_cast<std::int64_t>(row);
      double of_particle = truths.energy[row];
      for (; step < steps.size() && steps.truth[step] == static_cast<std::int64_t>(row); ++step) {
        if (!steps.is_delta(step)) continue;
        of_particle -= steps.energy[step];
        const Point at = steps.end(step, 0);
        const double gain = gains.at(detector, number, std::atan2(at.y, at.x), at.z);
        share(detector.layers[number], steps.end(step, -0.5), steps.end(step, 0.5),
              gain * steps.energy[step] * per_energy, readout.sigma, strip, parts);
      }
      const double gain = gains.at(detector, number, truths.phi[row], truths.z[row]);
      share(detector.layers[number], truths.entry_point(row), truths.exit_point(row),
            gain * std::max(of_particle, 0.0) * per_energy, readout.sigma, strip, parts);
    }
    const Stream stream(readout.seed, static_cast<std::uint64_t>(truths.event[begin]), 0);
    parts.write(truths.event[begin], digis, [&](DigiRow& digi) {
      const auto gid = static_cast<std::uint32_t>(digi.gid);
      digi.charge += readout.noise * stream.normals(Purpose::readout_strip, gid)[0];
      return digi.charge > readout.threshold;
    });
  }
  return digis;
}

}  // namespace cgemit

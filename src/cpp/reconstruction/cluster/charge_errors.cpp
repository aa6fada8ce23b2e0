#include "reconstruction/cluster/charge_errors.hpp"

#include <algorithm>
#include <cmath>

#include "common/angles.hpp"
#include "common/rng.hpp"
#include "common/units.hpp"

namespace cgemit {
namespace {

// Where x lies among growing knots: the number of the one below, and the share of the way to the next.
struct Place {
  std::size_t below;
  double share;
};
Place place_in(std::span<const double> knots, double x) {
  if (knots.size() < 2 || !(x > knots.front())) return {0, 0.0};
  if (x >= knots.back()) return {knots.size() - 2, 1.0};
  const auto above = static_cast<std::size_t>(std::ranges::upper_bound(knots, x) - knots.begin());
  return {above - 1, (x - knots[above - 1]) / (knots[above] - knots[above - 1])};
}

}  // namespace

double ShareTable::at(std::size_t layer, double path, double number) const {
  const Place i = place_in(paths, path), k = place_in(numbers, number);
  const auto row = [&](std::size_t p) {
    const double* const at = &values[(layer * paths.size() + p) * numbers.size() + k.below];
    return k.share > 0 ? at[0] + k.share * (at[1] - at[0]) : at[0];
  };
  const double low = row(i.below);
  return i.share > 0 ? low + i.share * (row(i.below + 1) - low) : low;
}

double strip_wave(double pitch, double variance) {
  return pitch * pitch / (2 * pi * pi) * std::exp(-4 * pi * pi * variance / (pitch * pitch));
}

// C. Kobetich and R. Katz, Phys. Rev. 170 (1968) 391, for the energy that sets free the electrons at 26 eV
// each, in a gas of 1.7 mg/cm^3. Beyond 3 mm the charge is a cluster of its own.
double delta_range(double electrons) {
  constexpr double keV_per_electron = 0.026, density = 1.7e-4, farthest = 3;  // g/cm^2 per mm
  const double energy = keV_per_electron * std::max(electrons, 0.0);
  return std::min(5.37e-4 * energy * (1 - 0.9815 / (1 + 3.123e-3 * energy)) / density, farthest);
}

double ChargeErrors::span(const PlaneErrors& plane, double slope) const {
  const double width = square(plane.pitch) / 12 + plane.cloud + plane.diffusion;
  return std::sqrt(12 / (12 / square(plane.gap) + square(slope) / width));
}

double ChargeErrors::electrons(const ChargeMoments& charge) const {
  return std::max(charge.charge * chip.electrons_per_fC, 2.0);
}

// A leading edge that rises as Q (t/rise)^2 passes the level A with the slope 2 sqrt(A Q)/rise.
double ChargeErrors::edge_variance(const PlaneErrors& plane, const ChargeMoments& charge) const {
  const double of_strip = charge.charge / charge.strips;
  const double level = chip.level > 0 ? chip.level * of_strip : plane.threshold;
  return square(chip.rise * chip.noise) / (4 * level * of_strip);
}

double ChargeErrors::height_variance(int view, std::size_t layer, const ChargeMoments& charge,
                                     Direction direction) const {
  const PlaneErrors& at = plane(view, layer);
  const double fluctuation =
      square(span(at, direction.slope)) * shares.at(layer, direction.path, electrons(charge));
  const double time = square(chip.jitter) * charge.squares + edge_variance(at, charge) / charge.strips;
  return chip.span * fluctuation + chip.time * square(at.velocity) * time;
}

// What all positions have: diffusion, the strips' width, charge that is wider than usual, delta electrons.
double ChargeErrors::common(const PlaneErrors& plane, std::size_t layer, const ChargeMoments& charge,
                            double path, double excess) const {
  const double number = electrons(charge);
  const double noise =
      square(chip.noise * plane.pitch / charge.charge) * charge.strips * (square(charge.strips) - 1) / 12;
  // The charge of a single strip is where its neighbours have less than the threshold, whose shares
  // fluctuate: half of the variance of a position anywhere there.
  double alone = 0;
  if (charge.strips < 1.5) {
    const double least = std::clamp(plane.threshold / charge.charge, 1e-6, 0.5);
    const double width = std::sqrt(plane.cloud + plane.diffusion);
    alone = std::max(0.0, plane.pitch + 2 * width * normal_quantile(least));
  }
  // The share of the largest ionization cluster, and how far its electrons reach. A share f beside the rest
  // by d moves the mean by f d and adds f (1 - f) d^2 to the width.
  const double single = (1 + chip.gain_variance) / number;
  const double largest = std::max(shares.at(layer, path, number) - single, 0.0);
  const double part = std::min(std::sqrt(largest), 0.75);
  return chip.diffusion * plane.diffusion * single + plane.wave + noise + square(alone) / 24 +
         chip.wide * std::max(excess, 0.0) * part / (1 - part) +
         largest * square(delta_range(std::sqrt(largest) * number));
}

double ChargeErrors::cut_variance(int view, std::size_t layer, const ChargeMoments& charge,
                                  Direction direction) const {
  const PlaneErrors& at = plane(view, layer);
  // Strips lose charge anywhere where the charge fluctuates along the path, else at the ends.
  const double along = square(direction.slope) * (square(at.gap) / 12);
  const double usual = along + at.cloud + at.diffusion + square(at.pitch) / 12;
  const double lost =
      square(at.threshold / charge.charge) * (chip.gain_variance > 0 ? square(charge.strips) * along : usual);
  return chip.cut * lost;
}

double ChargeErrors::of_centroid(int view, std::size_t layer, const ChargeMoments& charge,
                                 Direction direction) const {
  const PlaneErrors& at = plane(view, layer);
  const double along = square(direction.slope) * (square(at.gap) / 12);
  const double usual = along + at.cloud + at.diffusion + square(at.pitch) / 12;
  return chip.ionization * along * shares.at(layer, direction.path, electrons(charge)) +
         cut_variance(view, layer, charge, direction) +
         common(at, layer, charge, direction.path, charge.xx - usual);
}

double ChargeErrors::of_charge_line(int view, std::size_t layer, const ChargeMoments& charge,
                                    Direction direction, double slope_variance) const {
  const PlaneErrors& at = plane(view, layer);
  const double slope = direction.slope, usual = at.cloud + at.diffusion;
  const double across = charge.xx - 2 * slope * charge.xh + square(slope) * charge.hh;
  const double lost = square(at.threshold / charge.charge * at.pitch) / 12;
  return square(slope) * height_variance(view, layer, charge, direction) +
         square(charge.height) * slope_variance + chip.cut * lost +
         common(at, layer, charge, direction.path, across - usual - square(at.pitch) / 12);
}

double ChargeErrors::of_free_line(int view, std::size_t layer, const ChargeMoments& charge,
                                  Direction direction) const {
  const PlaneErrors& at = plane(view, layer);
  const double free = charge.squares * (square(at.pitch) / 12 + at.cloud) / std::max(charge.hh, 0.01);
  return of_charge_line(view, layer, charge, direction, 0) +
         chip.line * (square(charge.height) + charge.hh * charge.squares) * free;
}

OwnSlope ChargeErrors::own_slope(const PlaneErrors& plane, const ChargeMoments& charge, double span) const {
  // Strips have the mean heights of their charge, which spread less than the charge itself, and noise adds to
  // them.
  const double time = square(chip.jitter) + edge_variance(plane, charge);
  const double spread =
      std::max(charge.hh - chip.time * square(plane.velocity) * time * (1 - charge.squares), 0.0);
  const double width = square(plane.pitch) / 12 + plane.cloud + plane.diffusion;
  return {charge.xh / (spread + square(span) / 12), spread / charge.squares / width};
}

double ChargeErrors::expected(Estimator estimator, bool of_track, int view, std::size_t layer,
                              Direction direction, double number) const {
  // docs/methods/readout.md compares 0.6, 0.9, 0.8 and 0.014 below with clusters of random designs.
  const PlaneErrors& at = plane(view, layer);
  const double heights = square(at.gap) / 12, seen = span(at, direction.slope);
  ChargeMoments charge;
  charge.charge = number / chip.electrons_per_fC;
  charge.hh = heights - square(seen) / 12;
  const double width = at.cloud + at.diffusion + square(at.pitch) / 12;
  charge.xx = square(direction.slope) * heights + width;
  // Strips have unequal charges as far as few ionization clusters have most of it, and one strip more has
  // charge above the threshold.
  const double even = at.pitch / std::sqrt(12 * charge.xx), share = shares.at(layer, direction.path, number);
  charge.squares = even + 0.6 * share * (1 - even);
  charge.strips = 1 / charge.squares + 0.9;
  charge.height = std::sqrt(heights * share);
  // What the charge is wider than usual in the mean of those that are: by chance, and by the jitter of
  // heights.
  charge.xx += 0.8 * square(direction.slope * at.velocity * chip.jitter);
  charge.xh = direction.slope * (heights + charge.hh) / 2;  // of strips with the mean heights of their charge
  // By chance charge that fluctuates is wider than usual: the mean of what this adds, whatever a chip's
  // factor.
  const double chance = chip.gain_variance > 0 ? 0.014 * width : 0;
  if (estimator == Estimator::centroid && !of_track)
    return chance + of_centroid(view, layer, charge, direction);
  if (estimator == Estimator::micro_tpc && !of_track)
    return chance + of_free_line(view, layer, charge, direction);
  // Tracks from the beam line have the slope that is assumed.
  return chance + of_charge_line(view, layer, charge, direction, 0);
}

}  // namespace cgemit

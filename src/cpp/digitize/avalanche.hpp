// One electron of ionization on its way to the anode: drift, hole of the first foil, gain, and the
// avalanche's cloud on the strips (docs/methods/readout.md). Sources: PARSIFAL (github.com/Hilldar/PARSIFAL)
// and Magboltz.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include "common/rng.hpp"
#include "detector/strip_plane.hpp"
#include "digitize/strips.hpp"

namespace cgemit {

// Drift through one layer, as `cgemit.digitize.transport.LayerDrift` has it; all but the last two follow from
// gas and fields.
struct LayerDrift {
  double velocity;                     // mm/ns
  double tan_lorentz;                  // positive towards larger phi
  double sigma_x, sigma_par, sigma_l;  // mm/sqrt(mm), in the drift gap along phi, along z, along the drift
  double shift;                        // rad, of the gaps behind the first foil
  double delay, induction;             // ns, of the transfer gaps and of the induction gap
  double first_phi, first_z;           // rad, mm, diffusion of one electron in the first transfer gap
  double cloud_phi, cloud_z;           // rad, mm, width of an avalanche at the anode
  double hole_pitch;                   // mm, of the first foil; 0: electrons keep their position
  double w_value;                      // keV per electron of ionization
};

// Which physics acts, and how strongly.
struct ElectronPhysics {
  double survival;    // probability that an electron enters a hole and its avalanche reaches the anode
  double gain;        // mean number of electrons on the anode per surviving electron
  double polya;       // theta of the Polya distribution of the gain; infinite: no fluctuation
  double diffusion;   // factor on the widths of the drift gap and of the cloud; 0: none
  double first_gain;  // electrons behind the first foil per surviving electron
  bool lorentz;       // whether the Lorentz angle acts
  bool correlated;    // drift diffusion moves an avalanche as a whole, as it does in nature
};

// Uniform numbers of one electron: consecutive blocks of a counter that no other electron uses. 64 blocks
// each.
class ElectronDraws {
 public:
  static constexpr std::uint32_t blocks = 64, per_place = 4096 / blocks;

  // `place`: of the truth, with the lower 16 bits free; `electron`: its number in the truth.
  ElectronDraws(const Stream& stream, std::uint32_t place, std::uint32_t electron)
      : stream_(stream),
        place_(place | ((electron / per_place) & 0xFFFFU)),
        block_((electron % per_place) * blocks) {}
  double uniform() {
    if (used_ == 4) {
      words_ = stream_.block(Purpose::readout_electron, place_, block_++);
      used_ = 0;
    }
    return open_unit(words_[used_++]);
  }
  double normal() { return normal_quantile(uniform()); }

 private:
  const Stream& stream_;
  std::uint32_t place_, block_;
  std::size_t used_ = 4;
  Block words_{};
};

// Gain relative to its mean: Polya distribution, a gamma distribution of shape 1 + theta and mean 1, by the
// method of G. Marsaglia and W. W. Tsang, ACM Trans. Math. Softw. 26 (2000) 363. `theta` is not negative.
inline double polya_gain(double theta, ElectronDraws& draws) {
  const double d = 1 + theta - 1.0 / 3, c = 1 / std::sqrt(9 * d);
  for (;;) {
    const double x = draws.normal(), root = 1 + c * x;
    const double u = draws.uniform();
    if (root <= 0) continue;
    const double v = root * root * root;
    // A bound of theirs that implies the condition and spares the logarithms.
    if (u < 1 - 0.0331 * (x * x) * (x * x)) return d * v / (1 + theta);
    if (std::log(u) < 0.5 * x * x + d - d * v + d * std::log(v)) return d * v / (1 + theta);
  }
}

// The hole nearest to a point (mm) of a hexagonal lattice, holes at (i + j/2, j sqrt(3)/2) pitches.
inline void to_nearest_hole(double pitch, double& u, double& v) {
  constexpr double row = 0.86602540378443864676;  // sqrt(3)/2
  const auto [i0, j0] = std::pair(u / pitch - v / (2 * row * pitch), v / (row * pitch));
  double best = std::numeric_limits<double>::infinity(), at_u = u, at_v = v;
  for (int corner = 0; corner < 4; ++corner) {  // the nearest hole is a corner of the lattice's cell
    const double i = std::floor(i0) + corner % 2, j = std::floor(j0) + corner / 2;
    const double hole_u = (i + 0.5 * j) * pitch, hole_v = j * row * pitch;
    const double square = (u - hole_u) * (u - hole_u) + (v - hole_v) * (v - hole_v);
    if (square < best) best = square, at_u = hole_u, at_v = hole_v;
  }
  u = at_u;
  v = at_v;
}

// An electron where its avalanche reaches the anode.
struct Arrival {
  double phi, z;  // rad, mm, centre of the cloud
  double spread_phi,
      spread_z;   // rad, mm, width that the drift gap adds to the cloud; 0 where it moves all of it
  double time;    // ns after the particle, when the cloud enters the induction gap
  double charge;  // electrons
};

// Drift of an electron from (r, phi, z) in the drift gap. Diffusion is drawn once for the electron: its
// avalanche keeps the place where the electron arrived at the first foil.
inline Arrival drift(const CgemLayer& layer, const LayerDrift& gas, const ElectronPhysics& physics, double r,
                     double phi, double z, ElectronDraws& draws) {
  const double inside = std::clamp(r, layer.r_gap_in, layer.r_gap_out);
  const double length = layer.r_gap_out - inside, root = physics.diffusion * std::sqrt(length);
  const double bend = physics.lorentz ? 1 : 0;
  double at_phi = phi + bend * gas.tan_lorentz * std::log(layer.r_gap_out / inside);
  double at_z = z;
  const double n_phi = draws.normal(), n_z = draws.normal(), n_time = draws.normal();
  double spread_phi = root * gas.sigma_x / layer.r_gap_out, spread_z = root * gas.sigma_par;
  if (physics.correlated) {
    at_phi += spread_phi * n_phi;
    at_z += spread_z * n_z;
    spread_phi = spread_z = 0;
  }
  if (gas.hole_pitch > 0) {
    double u = layer.r_gap_out * at_phi;
    to_nearest_hole(gas.hole_pitch, u, at_z);
    at_phi = u / layer.r_gap_out;
  }
  const double few =
      physics.diffusion / std::sqrt(physics.first_gain);  // mean of the electrons behind the foil
  at_phi += few * gas.first_phi * draws.normal() + bend * gas.shift;
  at_z += few * gas.first_z * draws.normal();
  const double time = length / gas.velocity + root * gas.sigma_l * n_time / gas.velocity + gas.delay;
  const double gain = std::isinf(physics.polya) ? 1.0 : polya_gain(physics.polya, draws);
  return {at_phi, at_z, spread_phi, spread_z, time, gain * physics.gain};
}

// Part of a Gaussian below `x`, in units of its width.
inline double below(double x) { return 0.5 * std::erfc(-x * 0.70710678118654752440); }

// The same from a table, within 1e-9: the function and three derivatives at the nearest of its points.
class NormalTable {
 public:
  NormalTable() {
    for (int i = 0; i <= points; ++i) {
      const double x = i * step - reach;
      integral_[static_cast<std::size_t>(i)] = below(x);
      density_[static_cast<std::size_t>(i)] = 0.39894228040143267794 * std::exp(-0.5 * x * x);
    }
  }
  double below_at(double x) const {
    if (x <= -reach) return 0;
    if (x >= reach) return 1;
    const int i = static_cast<int>((x + reach) / step + 0.5);
    const double at = i * step - reach, d = x - at, density = density_[static_cast<std::size_t>(i)];
    return integral_[static_cast<std::size_t>(i)] +
           density * d * (1 - d * (0.5 * at - d * (at * at - 1) / 6));
  }

 private:
  static constexpr double reach = 6.5, step = 1.0 / 64;
  static constexpr int points = 832;
  std::array<double, points + 1> integral_, density_;
};
inline const NormalTable& normal_table() {
  static const NormalTable table;
  return table;
}

// Part of a Gaussian at `mean` within [low, high].
inline double part_within(double mean, double sigma, double low, double high) {
  constexpr double far = 6;
  if (mean - far * sigma > low && mean + far * sigma < high) return 1;
  return below((high - mean) / sigma) - below((low - mean) / sigma);
}

// Calls give(strip, part) for each of the `strips` strips, counted from `position` in strips, that holds a
// part of a Gaussian cloud of width `sigma` strips.
template <class Give>
void share_cloud(double position, double sigma, int strips, double inside, Give&& give) {
  constexpr double reach = 4;
  const int first = std::max(static_cast<int>(std::floor(position - reach * sigma)), 0);
  const int last = std::min(static_cast<int>(std::floor(position + reach * sigma)), strips - 1);
  if (first > last) return;
  const NormalTable& table = normal_table();
  double before = table.below_at((first - position) / sigma);
  for (int strip = first; strip <= last; ++strip) {
    const double up_to = table.below_at((strip + 1 - position) / sigma);
    give(strip, inside * (up_to - before));
    before = up_to;
  }
}

// The same for V strips of a cloud that reaches beyond the sheet: at each V only a part of it lies on the
// sheet, since X and z are correlated with V. Midpoint sums within the strips; exact at an edge, and an
// approximation at a corner, where both edges count as independent.
template <class Give>
void share_at_edge(const CgemLayer& layer, double x, double z, double sigma_x, double sigma_z, double sigma_v,
                   Give&& give) {
  constexpr double reach = 4;
  constexpr int parts = 16;
  const double v = local_v(layer, x, z), cos = layer.cos_stereo, sin = layer.sin_stereo;
  const double x_per_v = cos * sigma_x * sigma_x / (sigma_v * sigma_v);
  const double z_per_v = -sin * sigma_z * sigma_z / (sigma_v * sigma_v);
  const double rest_x = std::abs(sin) * sigma_x * sigma_z / sigma_v;
  const int first = std::max(static_cast<int>(std::floor(strips_of_v(layer, v - reach * sigma_v))), 0);
  const int last =
      std::min(static_cast<int>(std::floor(strips_of_v(layer, v + reach * sigma_v))), layer.strips_v - 1);
  for (int strip = first; strip <= last; ++strip) {
    double part = 0, before = below((v_of_strips(layer, strip) - v) / sigma_v);
    for (int i = 0; i < parts; ++i) {
      const double low = v_of_strips(layer, strip + static_cast<double>(i) / parts) - v;
      const double high = low + layer.pitch_v / parts, middle = 0.5 * (low + high);
      // At one V a step in x takes z along the strip.
      double from = -std::numeric_limits<double>::infinity(), to = -from;
      narrow(x + x_per_v * middle, 1, 0, layer.sheet_width(), from, to);
      narrow(z + z_per_v * middle, cos / sin, -layer.half_length, layer.half_length, from, to);
      const double up_to = below(high / sigma_v);
      if (from < to) part += (up_to - before) * (below(to / rest_x) - below(from / rest_x));
      before = up_to;
    }
    give(strip, part);
  }
}

// Calls give(sheet, view, strip, part) for the parts of a cloud at (phi, z) on the strips of both views; the
// parts of a view add up to what of the cloud is on the active area.
template <class Give>
void share_on_layer(const CgemLayer& layer, double phi, double z, double sigma_x, double sigma_z,
                    Give&& give) {
  constexpr double reach = 6;
  const double turn = 2 * pi * layer.r_readout, width = layer.sheet_width();
  const double in_z = part_within(z, sigma_z, -layer.half_length, layer.half_length);
  if (in_z <= 0) return;
  const double sigma_v = std::hypot(layer.cos_stereo * sigma_x, layer.sin_stereo * sigma_z);
  for (int sheet = 0; sheet < layer.sheets; ++sheet) {
    double x = local_x(layer, sheet, phi);
    if (x > width + reach * sigma_x) x -= turn;
    if (x < -reach * sigma_x) continue;
    const auto on_x = [&](int strip, double part) { give(sheet, 0, strip, part); };
    const auto on_v = [&](int strip, double part) { give(sheet, 1, strip, part); };
    share_cloud(strips_of_x(layer, x), sigma_x / layer.pitch_x, layer.strips_x, in_z, on_x);
    if (in_z < 1 || part_within(x, sigma_x, 0, width) < 1) {
      share_at_edge(layer, x, z, sigma_x, sigma_z, sigma_v, on_v);
    } else {
      share_cloud(strips_of_v(layer, local_v(layer, x, z)), sigma_v / layer.pitch_v, layer.strips_v, 1.0,
                  on_v);
    }
  }
}

}  // namespace cgemit

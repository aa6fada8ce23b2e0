// Electrons of ionization on their way to the anode, one or several side by side: drift, hole, gain, cloud
// (docs/methods/readout.md). Sources: PARSIFAL (github.com/Hilldar/PARSIFAL) and Magboltz.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <span>
#include <tuple>

#include "common/columns.hpp"
#include "common/lanes/philox.hpp"
#include "common/rng.hpp"
#include "detector/strip_plane.hpp"
#include "simulation/digitize/strips.hpp"

namespace cgemit {

// Drift through one layer, as `cgemit.detector.gas.LayerDrift` has it; all but the last two follow from
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

  static constexpr auto columns() {
    return std::tuple(Column("velocity", &LayerDrift::velocity),
                      Column("tan_lorentz", &LayerDrift::tan_lorentz),
                      Column("sigma_x", &LayerDrift::sigma_x), Column("sigma_par", &LayerDrift::sigma_par),
                      Column("sigma_l", &LayerDrift::sigma_l), Column("shift", &LayerDrift::shift),
                      Column("delay", &LayerDrift::delay), Column("induction", &LayerDrift::induction),
                      Column("first_phi", &LayerDrift::first_phi), Column("first_z", &LayerDrift::first_z),
                      Column("cloud_phi", &LayerDrift::cloud_phi), Column("cloud_z", &LayerDrift::cloud_z),
                      Column("hole_pitch", &LayerDrift::hole_pitch), Column("w_value", &LayerDrift::w_value));
  }
};

// Which physics acts, and how strongly.
struct ElectronPhysics {
  double survival;    // probability that an electron enters a hole and its avalanche reaches the anode
  double gain;        // mean number of electrons on the anode per surviving electron
  double polya;       // theta of the Polya distribution of the gain; infinite: no fluctuation
  double diffusion;   // factor on the widths of the drift gap and of the cloud; 0: none
  double first_gain;  // electrons behind the first foil per surviving electron
  bool lorentz;       // whether the Lorentz angle acts
};

// Uniform numbers of one electron, or of one in each lane: consecutive blocks of a counter that no other
// electron uses. 64 blocks each.
template <class T>
class ElectronDraws {
 public:
  static constexpr std::uint32_t blocks = 64, per_place = 4096 / blocks;

  // `place`: of the truth, with the lower 16 bits free; `electron`: number in the truth of the first lane's.
  ElectronDraws(const Stream& stream, std::uint32_t place, std::uint32_t electron) {
    for (int i = 0; i < lanes_of<T>; ++i) {
      const std::uint32_t own = electron + static_cast<std::uint32_t>(i);
      series_.set(i, stream, Purpose::readout_electron, place | ((own / per_place) & 0xFFFFU),
                  (own % per_place) * blocks);
    }
  }
  T uniform() {
    if (used_ == 4) {
      words_ = series_.next();
      used_ = 0;
    }
    return open_unit(words_[used_++]);
  }
  T normal() { return normal_quantile(uniform()); }

 private:
  BlockSeries<T> series_;
  std::size_t used_ = 4;
  BlockOf<T> words_{};
};

// Gain relative to its mean: Polya distribution, a gamma distribution of shape 1 + theta and mean 1, by the
// method of G. Marsaglia and W. W. Tsang, ACM Trans. Math. Softw. 26 (2000) 363. `theta` is not negative. 1
// in lanes that are not wanted.
template <class T>
T polya_gain(double theta, ElectronDraws<T>& draws, mask_of<T> wanted = true) {
  const double d = 1 + theta - 1.0 / 3, c = 1 / std::sqrt(9 * d);
  T gain(1.0);
  while (any(wanted)) {
    const T x = draws.normal(), root = 1.0 + c * x;
    const T u = draws.uniform();
    const T v = root * root * root;
    // A bound of theirs that implies the condition and spares the logarithms.
    mask_of<T> taken = wanted & (root > 0.0) & (u < 1.0 - 0.0331 * (x * x) * (x * x));
    const mask_of<T> open = wanted & (root > 0.0) & !taken;
    if (any(open)) {
      const T positive = select(open, v, 1.0);
      taken = taken | (open & (log(u) < 0.5 * x * x + d - d * v + d * log(positive)));
    }
    gain = select(taken, d * v / (1 + theta), gain);
    wanted = wanted & !taken;
  }
  return gain;
}

// Largest whole number that is not larger, |x| < 2^51.
template <class T>
T whole_below(T x) {
  const T n = nearest(x);
  return n - select(n > x, T(1.0), T(0.0));
}

// The hole nearest to a point (mm) of a hexagonal lattice, holes at (i + j/2, j sqrt(3)/2) pitches.
template <class T>
void to_nearest_hole(double pitch, T& u, T& v) {
  constexpr double row = 0.86602540378443864676;  // sqrt(3)/2
  const T i0 = whole_below(u / pitch - v / (2 * row * pitch)), j0 = whole_below(v / (row * pitch));
  T best(std::numeric_limits<double>::infinity()), at_u = u, at_v = v;
  for (int corner = 0; corner < 4; ++corner) {  // the nearest hole is a corner of the lattice's cell
    const T i = i0 + static_cast<double>(corner % 2), j = j0 + static_cast<double>(corner / 2);
    const T hole_u = (i + 0.5 * j) * pitch, hole_v = j * row * pitch;
    const T square = (u - hole_u) * (u - hole_u) + (v - hole_v) * (v - hole_v);
    const mask_of<T> nearer = square < best;
    best = select(nearer, square, best);
    at_u = select(nearer, hole_u, at_u);
    at_v = select(nearer, hole_v, at_v);
  }
  u = at_u;
  v = at_v;
}

// Electrons where their avalanches reach the anode.
template <class T>
struct Arrival {
  T phi, z;  // rad, mm, centre of the cloud
  T time;    // ns after the particle, when the cloud enters the induction gap
  T charge;  // electrons
};

// Drift of electrons from (x, y, z) in the drift gap, of those `wanted`. Diffusion is drawn once for an
// electron and moves its avalanche as a whole, which keeps the place where the electron arrived at the first
// foil.
template <class T>
Arrival<T> drift(const MeasuringLayer& layer, const LayerDrift& gas, const ElectronPhysics& physics, T x, T y,
                 T z, ElectronDraws<T>& draws, mask_of<T> wanted) {
  const T inside = smaller(larger(sqrt(x * x + y * y), layer.r_gap_in), layer.r_gap_out);
  const T length = layer.r_gap_out - inside, root = physics.diffusion * sqrt(length);
  const double bend = physics.lorentz ? 1 : 0;
  T at_phi = atan2(y, x) + bend * gas.tan_lorentz * log(layer.r_gap_out / inside);
  T at_z = z;
  const T n_phi = draws.normal(), n_z = draws.normal(), n_time = draws.normal();
  const T spread_phi = root * gas.sigma_x / layer.r_gap_out, spread_z = root * gas.sigma_par;
  at_phi += spread_phi * n_phi;
  at_z += spread_z * n_z;
  if (gas.hole_pitch > 0) {
    T u = layer.r_gap_out * at_phi;
    to_nearest_hole(gas.hole_pitch, u, at_z);
    at_phi = u / layer.r_gap_out;
  }
  const double few =
      physics.diffusion / std::sqrt(physics.first_gain);  // mean of the electrons behind the foil
  at_phi += few * gas.first_phi * draws.normal() + bend * gas.shift;
  at_z += few * gas.first_z * draws.normal();
  const T time = length / gas.velocity + root * gas.sigma_l * n_time / gas.velocity + gas.delay;
  const T gain = std::isinf(physics.polya) ? T(1.0) : polya_gain(physics.polya, draws, wanted);
  return {at_phi, at_z, time, gain * physics.gain};
}

// Part of a Gaussian below `x`, in units of its width.
inline double below(double x) { return 0.5 * std::erfc(-x * 0.70710678118654752440); }

// The same from a table, within 1e-9: the function and three derivatives at the nearest of its points.
class NormalTable {
 public:
  NormalTable() {
    for (int i = 1; i < points; ++i) {
      const double x = i * step - reach;
      points_[static_cast<std::size_t>(i)] = {below(x), 0.39894228040143267794 * std::exp(-0.5 * x * x)};
    }
    points_.back() = {1, 0};
  }
  double below_at(double x) const {
    const double inside = std::clamp(x, -reach, reach), nth = std::round((inside + reach) * (1 / step));
    const Tabulated& found = points_[static_cast<std::size_t>(nth)];
    const double at = nth * step - reach, d = inside - at;
    return found.integral + found.density * d * (1.0 - d * (0.5 * at - d * (at * at - 1.0) * (1.0 / 6)));
  }

 private:
  struct Tabulated {
    double integral, density;
  };
  static constexpr double reach = 6.5, step = 1.0 / 64;
  static constexpr int points = 832;
  std::array<Tabulated, points + 1> points_{};
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

// Part of the charge of V strips, from `first` on, that is on the sheet, for a cloud at (x, z) that reaches
// beyond it: at each V only a part of the cloud lies on the sheet, since X and z are correlated with V.
// Midpoint sums within the strips; exact at an edge, and an approximation at a corner, where both edges count
// as independent.
inline void parts_on_sheet(const MeasuringLayer& layer, double x, double z, double sigma_x, double sigma_z,
                           int first, std::span<double> found) {
  constexpr int parts = 16;
  constexpr double least = 1e-4;  // of the cloud, on strips with a part of their own
  const NormalTable& table = normal_table();
  const double v = local_v(layer, x, z), cos = layer.cos_stereo, sin = layer.sin_stereo;
  const double sigma_v = std::hypot(cos * sigma_x, sin * sigma_z);
  const double x_per_v = cos * sigma_x * sigma_x / (sigma_v * sigma_v);
  const double z_per_v = -sin * sigma_z * sigma_z / (sigma_v * sigma_v);
  const double rest_x = std::abs(sin) * sigma_x * sigma_z / sigma_v;
  const auto of_strip = [&](int strip, double whole) {
    double part = 0, before = table.below_at((v_of_strips(layer, strip) - v) / sigma_v);
    for (int i = 0; i < parts; ++i) {
      const double low = v_of_strips(layer, strip + static_cast<double>(i) / parts) - v;
      const double high = low + layer.pitch_v / parts, middle = 0.5 * (low + high);
      // At one V a step in x takes z along the strip.
      double from = -std::numeric_limits<double>::infinity(), to = -from;
      narrow(x + x_per_v * middle, 1, 0, layer.sheet_width(), from, to);
      narrow(z + z_per_v * middle, cos / sin, layer.ends.low, layer.ends.high, from, to);
      const double up_to = table.below_at(high / sigma_v);
      if (from < to) part += (up_to - before) * (table.below_at(to / rest_x) - table.below_at(from / rest_x));
      before = up_to;
    }
    return part / whole;
  };
  std::size_t begin = found.size(), end = 0;
  for (std::size_t i = 0; i < found.size(); ++i) {
    const int strip = first + static_cast<int>(i);
    const double whole = table.below_at((v_of_strips(layer, strip + 1) - v) / sigma_v) -
                         table.below_at((v_of_strips(layer, strip) - v) / sigma_v);
    if (whole < least) continue;
    found[i] = of_strip(strip, whole);
    begin = std::min(begin, i);
    end = i + 1;
  }
  for (std::size_t i = 0; i < begin; ++i) found[i] = begin < found.size() ? found[begin] : 0;
  for (std::size_t i = std::max(begin, end); i < found.size(); ++i) found[i] = found[end - 1];
}

}  // namespace cgemit

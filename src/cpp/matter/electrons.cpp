#include "matter/electrons.hpp"

#include <algorithm>
#include <bit>
#include <cmath>

#include "common/units.hpp"

namespace cgemit {

namespace {

constexpr double longest_step = 1.5;        // mm in the gap, to be drawn as a straight piece
constexpr double largest_turn = 0.3;        // rad in the field in one step
constexpr double shortest_piece = 0.05;     // mm; shorter ones are joined
constexpr double farthest = 50;             // mm in u; beyond, layers are no planes and others lie on the way
constexpr std::uint32_t most_steps = 4096;  // blocks of random numbers per stream: a metre of gas

// What a layer does to an electron of the energy it has.
struct Local : ElectronPoint {
  double slope;  // d(stopping)/d(energy), 1/mm
};

// The grid is read off the number itself: exponent and first four bits of the mantissa are the bin.
Local local(const ElectronLayer& layer, double energy) {
  static const std::uint64_t first = std::bit_cast<std::uint64_t>(electron_grid_first) >> 48;
  const auto bits = std::bit_cast<std::uint64_t>(energy);
  const auto bin = std::min<std::uint64_t>((bits >> 48) - first, electron_points - 2);
  const double part = static_cast<double>(bits & 0xFFFFFFFFFFFF) * 0x1p-48;
  const double width = std::bit_cast<double>(bits >> 52 << 52) / electron_steps;
  const ElectronPoint &a = layer.at[bin], &b = layer.at[bin + 1];
  const auto between = [part](double low, double high) { return low + part * (high - low); };
  return {
      {between(a.stopping, b.stopping), between(a.path, b.path), between(a.cut, b.cut),
       between(a.screening, b.screening), between(a.soft, b.soft), between(a.per_momentum, b.per_momentum)},
      (b.stopping - a.stopping) / width};
}

// Turns the direction about the field.
void turn(Electron& electron, double angle) {
  const double q = angle * angle;  // at most largest_turn^2: next terms below 1e-6
  const double cosine = 1 - q / 2 * (1 - q / 12), sine = angle * (1 - q / 6 * (1 - q / 20));
  const double dw = cosine * electron.dw - sine * electron.du;
  electron.du = cosine * electron.du + sine * electron.dw;
  electron.dw = dw;
}

double hard_scatter(const Local& here, double uniform) {
  const double most = 1 / (here.cut + here.screening), least = 1 / (1 + here.screening);
  return 1 / (most - uniform * (most - least)) - here.screening;
}

// Soft scatters on a way: the mean cosines of successive ones multiply, mu is exponential about its mean.
double soft_scatter(const Local& here, double way, double uniform) {
  const double sum = here.soft * way;
  const double mean = sum < 0.05 ? sum * (1 - sum) : 0.5 * (1 - std::exp(-2 * sum));
  return std::min(-mean * std::log(uniform), 1.0);
}

// Directions around a circle.
struct Around {
  double cosine, sine;
};
Around around(std::uint32_t sixteen_bits) {
  static const auto circle = [] {
    std::array<Around, 1024> table{};
    for (std::size_t i = 0; i < table.size(); ++i) {
      const double angle = 2 * pi * (static_cast<double>(i) + 0.5) / static_cast<double>(table.size());
      table[i] = {std::cos(angle), std::sin(angle)};
    }
    return table;
  }();
  return circle[sixteen_bits >> 6];
}

class Transport {
 public:
  Transport(const GapMatter& matter, Electron& electron, double bz, std::vector<Piece>& pieces)
      : matter_(matter), e_(electron), field_(bz / radius_per_kappa), pieces_(pieces) {
    const auto& layers = matter.layers;
    while (layer_ + 1 < layers.size() &&
           (e_.w > layers[layer_].w_out || (e_.w == layers[layer_].w_out && e_.dw > 0)))
      ++layer_;
    begin_piece();
  }

  double run(const Stream& stream, std::uint32_t place) {
    for (std::uint32_t i = 0; i < most_steps && step(stream.block(Purpose::deltas, place, i)); ++i) {
    }
    end_piece();
    return way_;
  }

 private:
  bool in_gap() const { return layer_ == matter_.gap; }

  // False at the end of the electron's way.
  bool step(const Block& words) {
    const ElectronLayer& layer = matter_.layers[layer_];
    const Local here = local(layer, e_.energy);
    const double bend = field_ * here.per_momentum;  // rad/mm, charge -1
    const double free_path = -here.path * std::log(open_unit(words[0]));
    const double longest = std::min(longest_allowed(here), largest_turn / std::abs(bend));
    double length = std::min(free_path, longest);
    Electron middle = e_;
    turn(middle, 0.5 * bend * length);
    const double border = to_border(layer, middle);
    const bool leaves = border <= length;
    if (leaves) length = border;
    move(middle, length);
    turn(e_, bend * length);
    if (!slow_down(here, length) || std::abs(e_.z) > matter_.half_length) return false;
    if (here.soft > 0) scatter(soft_scatter(here, length, open_unit(words[3])), around(words[2] >> 16));
    if (leaves) return cross_border(middle.dw > 0, bend);
    if (length == free_path) scatter(hard_scatter(here, open_unit(words[1])), around(words[2] & 0xFFFF));
    return in_gap() || can_return(layer);
  }

  // The loss on a step is taken to second order: up to a quarter of the energy.
  double longest_allowed(const Local& here) const {
    const double loss = 0.25 * e_.energy / here.stopping;
    return in_gap() ? std::min(loss, longest_step) : loss;
  }

  static double to_border(const ElectronLayer& layer, const Electron& e) {
    if (e.dw == 0) return HUGE_VAL;
    return std::max(((e.dw > 0 ? layer.w_out : layer.w_in) - e.w) / e.dw, 0.0);
  }

  void scatter(double mu, const Around& azimuth) { deflect(e_, mu, azimuth.cosine, azimuth.sine); }

  void move(const Electron& direction, double length) {
    e_.u += length * direction.du;
    e_.w += length * direction.dw;
    e_.z += length * direction.dz;
    way_ += length;
  }

  bool slow_down(const Local& here, double length) {
    const double first = here.stopping * length;
    double loss = first * (1 - 0.5 * here.slope * length);
    const bool ends = e_.energy - loss < least_electron;
    if (ends) loss = e_.energy;
    e_.energy -= loss;
    if (in_gap()) {
      piece_.energy += loss;
      const double du = e_.u - piece_.from[0], dw = e_.w - piece_.from[1], dz = e_.z - piece_.from[2];
      if (du * du + dw * dw + dz * dz > shortest_piece * shortest_piece) end_piece();
    }
    return !ends;
  }

  // False where the electron does not come back.
  bool cross_border(bool outward, double bend) {
    end_piece();
    const bool last = outward ? layer_ + 1 == matter_.layers.size() : layer_ == 0;
    if (!last) layer_ = outward ? layer_ + 1 : layer_ - 1;
    const ElectronLayer& layer = matter_.layers[layer_];
    e_.w = outward != last ? layer.w_in : layer.w_out;
    if (last && !curl_back(outward, bend)) return false;
    begin_piece();
    return in_gap() || can_return(layer);
  }

  // The way outside, where nothing but the field acts: a turn until the electron meets the layers again.
  bool curl_back(bool outward, double bend) {
    if ((e_.dw > 0) != outward) return true;  // the field has turned it back on the border
    const double along = 2 * e_.dw / bend;
    if (std::abs(along) > farthest) return false;
    const double angle = std::atan2(e_.du, std::abs(e_.dw));
    const double turned = (bend > 0) == outward ? pi - 2 * angle : pi + 2 * angle;
    const double length = turned / std::abs(bend);
    e_.u += along;
    e_.z += length * e_.dz;
    e_.dw = -e_.dw;
    way_ += length;
    return true;
  }

  bool can_return(const ElectronLayer& layer) const {
    const double way = layer_ < matter_.gap ? layer.w_out - e_.w : e_.w - layer.w_in;
    return practical_range(e_.energy) > layer.depth + layer.density * way;
  }

  void begin_piece() { piece_ = {{e_.u, e_.w, e_.z}, {}, 0}; }

  void end_piece() {
    if (in_gap() && piece_.energy > 0) {
      piece_.to = {e_.u, e_.w, e_.z};
      pieces_.push_back(piece_);
    }
    begin_piece();
  }

  const GapMatter& matter_;
  Electron& e_;
  double field_, way_ = 0;  // field: rad/mm at 1 GeV/c
  std::vector<Piece>& pieces_;
  Piece piece_{};
  std::size_t layer_ = 0;
};

}  // namespace

void deflect(Electron& e, double mu, double cos_azimuth, double sin_azimuth) {
  const double cosine = 1 - 2 * mu, sine = 2 * std::sqrt(std::max(mu * (1 - mu), 0.0));
  const double side = sine * cos_azimuth, up = sine * sin_azimuth;
  const double across = std::sqrt(e.du * e.du + e.dw * e.dw);
  if (across < 1e-6) {
    e = {e.u, e.w, e.z, side, up, std::copysign(cosine, cosine * e.dz), e.energy};
    return;
  }
  // Axes across the flight: (-dw, du, 0)/across and (-du dz, -dw dz, across^2)/across.
  const double first = side / across, second = up / across * e.dz;
  const double du = cosine * e.du - first * e.dw - second * e.du;
  const double dw = cosine * e.dw + first * e.du - second * e.dw;
  const double dz = cosine * e.dz + up * across;
  // Against rounding over thousands of steps: one step of Newton's towards length 1.
  const double norm = 1.5 - 0.5 * (du * du + dw * dw + dz * dz);
  e.du = du * norm;
  e.dw = dw * norm;
  e.dz = dz * norm;
}

double transport(const GapMatter& matter, Electron& electron, double bz, const Stream& stream,
                 std::uint32_t place, std::vector<Piece>& pieces) {
  return Transport(matter, electron, bz, pieces).run(stream, place);
}

}  // namespace cgemit

#include "matter/scattering.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <deque>
#include <utility>
#include <vector>

namespace cgemit {

namespace {

// Expected numbers of hard scatters: in the whole detector, shared among the slabs in proportion so that the
// result does not depend on how matter is cut; and the smallest and largest number in one slab.
constexpr double hard_in_all = 6, least_hard = 0.1, most_hard = 4;

// Moliere's screening angle squared times p^2 for beta = 0 of the correction below; Lynch and Dahl, eq. 4.
constexpr double screening_scale = 2.007e-5 * MeV * MeV;
// The correction is 1 + slow/beta^2 with slow = 3.34 (Z alpha)^2.
double slowness(double z) { return 3.34 * z * z * fine_structure * fine_structure; }

// Screening of an element; its powers are computed once, not at every point of the tables.
struct ScreeningOf {
  double scale, slow, geant;

  ScreeningOf(double z, Screening screening)
      : scale(screening_scale * std::pow(z, 2.0 / 3.0)),
        slow(slowness(z)),
        geant(screening == Screening::wentzel && z >= 2 ? 1 + std::exp(-z * z / 1000) : 1.0) {}

  double operator()(double per_beta2) const { return scale * (1 + slow * per_beta2) * geant; }
};

// Nuclear radius squared over 12, for the form factor (1 + (q R)^2/12)^-2 of an exponential charge
// distribution, R = 1.27 A^0.27 fm; Butkevich et al., Nucl. Instrum. Methods A 488 (2002) 282.
double nuclear_size(double a) {
  const double radius = 1.27 * std::pow(a, 0.27) / hbar_c;
  return radius * radius / 12;
}

// Transfer above which `wanted` scatters are expected at beta = 1; 0 if fewer are expected in all.
double transfer_for(const Slab& slab, double wanted, Screening screening) {
  std::vector<std::pair<double, double>> elements;  // strength and screening
  for (const Component& c : slab.components)
    elements.emplace_back(bethe_constant * electron_mass * c.z * (c.z + 1) * c.moles,
                          ScreeningOf(c.z, screening)(1));
  const auto expected = [&](double q2) {
    double n = 0;
    for (const auto& [strength, a2] : elements) n += strength / (q2 + a2);
    return n;
  };
  if (!(expected(0) > wanted)) return 0;
  double low = 0, high = slab.chi_c2 / wanted;
  for (int i = 0; i < 60; ++i) {
    const double middle = 0.5 * (low + high);
    (expected(middle) > wanted ? low : high) = middle;
  }
  return 0.5 * (low + high);
}

void prepare_hard(Slab& slab, Screening screening) {
  slab.hard.clear();
  slab.hard_rate = 0;
  for (const Component& c : slab.components) {
    const double a2 = ScreeningOf(c.z, screening)(1);
    slab.hard_rate += bethe_constant * electron_mass * c.z * (c.z + 1) * c.moles / (slab.hard_from + a2);
    slab.hard.push_back({slab.hard_rate, c.z, a2, slowness(c.z), nuclear_size(c.a)});
  }
  for (HardScatterer& h : slab.hard) h.up_to /= slab.hard_rate;
}

// The screening of an element on the grid of the tables. Slabs share elements.
struct ScreeningGrid {
  double z;
  std::array<double, loss_points> a2, log_a2;
};

class ScreeningGrids {
 public:
  explicit ScreeningGrids(Screening screening) : screening_(screening) {
    for (int i = 0; i < loss_points; ++i) {
      const double bg = std::exp(loss_grid_first + i * loss_grid_step);
      per_beta2_[static_cast<std::size_t>(i)] = 1 + 1 / (bg * bg);
    }
  }
  const ScreeningGrid& of(double z) {
    const auto known = std::ranges::find(grids_, z, &ScreeningGrid::z);
    if (known != grids_.end()) return *known;
    ScreeningGrid& grid = grids_.emplace_back();
    const ScreeningOf at(z, screening_);
    grid.z = z;
    for (std::size_t i = 0; i < grid.a2.size(); ++i) {
      grid.a2[i] = at(per_beta2_[i]);
      grid.log_a2[i] = std::log(grid.a2[i]);
    }
    return grid;
  }

 private:
  Screening screening_;
  std::array<double, loss_points> per_beta2_;
  std::deque<ScreeningGrid> grids_;  // references stay valid
};

void prepare_table(Slab& slab, bool drawn, ScreeningGrids& grids) {
  for (SlabPoint& point : slab.table) {
    point.log_screening = 0;
    point.soft = drawn ? 0 : std::nan("");
  }
  for (const Component& c : slab.components) {
    const double chi_c2 = bethe_constant * electron_mass * c.z * (c.z + 1) * c.moles;
    const ScreeningGrid& grid = grids.of(c.z);
    for (std::size_t i = 0; i < grid.a2.size(); ++i) {
      slab.table[i].log_screening += chi_c2 * grid.log_a2[i];
      if (!drawn) continue;
      const double ratio = slab.hard_from / grid.a2[i];
      slab.table[i].soft += 0.5 * chi_c2 * (std::log1p(ratio) - ratio / (1 + ratio));
    }
  }
  for (SlabPoint& point : slab.table) point.log_screening /= slab.chi_c2;
}

// One hard scatter, as a space angle; 0 if the proposed scatter is rejected.
double hard_angle(const Slab& slab, double p, double charge2_per_beta2, double recoil, Draws& draws) {
  const double which = draws.next();
  const auto h = std::ranges::find_if(slab.hard, [&](const HardScatterer& e) { return which <= e.up_to; });
  if (h == slab.hard.end()) return 0;
  const double q2 = (slab.hard_from + h->screening) / draws.next() - h->screening;
  const double screened = h->screening * (1 + h->slow * charge2_per_beta2) / (1 + h->slow);
  const double ratio = (q2 + h->screening) / (q2 + screened);
  const double choice = draws.next() * (h->z + 1), on_electron = choice - h->z;
  double accepted = ratio * ratio;
  if (on_electron > 0) {
    if (q2 > recoil) return 0;
  } else {
    const double form = 1 / (1 + q2 * h->size), form2 = form * form;
    accepted *= form2 * form2;
  }
  const double sine = 0.5 * std::sqrt(q2) / p;
  if (sine > 1 || draws.next() > accepted) return 0;
  return sine < 0.01 ? 2 * sine * (1 + sine * sine / 6) : 2 * std::asin(sine);  // next: 3/40 sine^5
}

}  // namespace

void prepare_scattering(Detector& detector, Screening screening, bool drawn) {
  ScreeningGrids grids(screening);
  double total = 0;
  for (Slab& slab : detector.slabs) {
    slab.chi_c2 = slab.chi_c2_electrons = 1e-30;  // logarithms must also exist for a slab of no matter
    for (const Component& c : slab.components) {
      const double electrons = bethe_constant * electron_mass * c.z * c.moles;
      slab.chi_c2 += electrons * (c.z + 1);
      slab.chi_c2_electrons += electrons;
    }
    total += slab.chi_c2;
  }
  for (Slab& slab : detector.slabs) {
    slab.hard_from = slab.hard_rate = 0;
    if (drawn) {
      const double wanted = std::clamp(hard_in_all * slab.chi_c2 / total, least_hard, most_hard);
      slab.hard_from = transfer_for(slab, wanted, screening);
      prepare_hard(slab, screening);
    }
    prepare_table(slab, drawn, grids);
  }
}

void share_scattering(Detector& detector, std::span<const std::array<double, 5>> parts,
                      const std::array<double, 5>& variances, const std::array<double, 5>& hits,
                      const Kinematics& start) {
  // Radius of the last surface that measures, mm; without any, as for layers of matter alone, all matter
  // counts.
  double last = detector.layers.empty() && detector.wires.empty() ? HUGE_VAL : 0;
  for (const MeasuringLayer& layer : detector.layers) last = std::max(last, layer.r_readout);
  for (const WireLayer& layer : detector.wires) last = std::max(last, std::sqrt(layer.waist));
  // Slabs on one side of z = 0 may not be crossed: their like is the next slab that is.
  const auto is_crossed = [&](std::size_t i) {
    const Ends& ends = detector.slabs[i].ends;
    return (ends.low < 0 && ends.high > 0) || std::ranges::any_of(parts[i], [](double v) { return v > 0; });
  };
  double before = 0;  // chi_c^2
  std::array<double, 5> scattered{};
  for (std::size_t i = 0; i < parts.size(); ++i) {
    if (detector.slabs[i].radius < last && is_crossed(i)) before += detector.slabs[i].chi_c2;
    for (std::size_t k = 0; k < scattered.size(); ++k) scattered[k] += parts[i][k];
  }
  for (std::size_t i = 0; i < parts.size(); ++i) {
    Slab& slab = detector.slabs[i];
    double weights = 0, logarithms = 0, more = 0;
    for (std::size_t k = 0; k < scattered.size(); ++k) {
      if (!(parts[i][k] > 0)) continue;
      const double weight = parts[i][k] / variances[k];
      weights += weight;
      logarithms += weight * std::log(scattered[k] / parts[i][k]);
      more += weight * std::log1p(hits[k] / scattered[k]);
    }
    if (!(weights > 0) || slab.radius >= last) continue;
    slab.acting = std::min(before, slab.chi_c2 * std::exp(logarithms / weights));
    slab.by_hits = std::expm1(more / weights) * start.charge2_per_beta2 * start.per_p * start.per_p;
  }
  for (std::size_t i = 0; i < parts.size(); ++i) {
    if (is_crossed(i) || !(detector.slabs[i].radius < last)) continue;
    double apart = HUGE_VAL;
    for (std::size_t k = 0; k < parts.size(); ++k) {
      const double off = std::abs(detector.slabs[k].radius - detector.slabs[i].radius);
      if (off >= apart || !is_crossed(k) || detector.slabs[k].filler != detector.slabs[i].filler) continue;
      apart = off;
      detector.slabs[i].acting = detector.slabs[k].acting;
      detector.slabs[i].by_hits = detector.slabs[k].by_hits;
    }
  }
}

void add_hard_scatters(const Slab& slab, int n, double p, double charge2_per_beta2, double recoil,
                       double depth, Draws& draws, Kick& kick) {
  for (int i = 0; i < n; ++i) {
    const double angle = hard_angle(slab, p, charge2_per_beta2, recoil, draws);
    if (angle == 0) continue;
    const auto [sine, cosine] = sine_cosine_of_turn(draws.next());
    const double a = angle * cosine, b = angle * sine;
    kick.angle_1 += a;
    kick.angle_2 += b;
    if (!slab.shifts) continue;
    // The scatter happens at a uniformly distributed depth of the slab, with the slab's spread.
    const double ahead = std::sqrt(12.0) * depth * (draws.next() - 0.5);
    kick.shift_1 += a * ahead;
    kick.shift_2 += b * ahead;
  }
}

}  // namespace cgemit

// Density of the momentum of electrons and positrons: losses above the soft ones, whose mean and variance the
// fit has, are breaks of the track (docs/methods/fit.md).
//
// A loss of the share y of the energy in a slab increases kappa beyond it. The fitted kappa changes by the
// share T of this increase ("unseen"), and the likelihood of the hits before the slab by
//   ln L(D) - ln L(0) = b D - B D^2/2,   D the increase,   b = u.l,  B = u^T Lambda u,
// with the first and second derivative (-l, Lambda) of -ln L in the smoother, and u the change of the helix
// at the origin per unit of kappa. Everything below is relative to the fitted kappa.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "common/compiler.hpp"
#include "kalman/filter.hpp"
#include "matter/loss.hpp"
#include "reconstruction/fit/fit.hpp"

namespace cgemit {

// Losses in consecutive slabs that are taken together, and what the hits tell of them.
template <class T>
struct Radiator {
  T x0{0.0};           // radiation lengths along the track
  T xi{0.0};           // Landau's xi over the energy
  T unseen{0.0};       // T
  T slope{0.0};        // b
  T information{0.0};  // B
  T scale{0.0};        // `Slab::per_unseen`
  double radius = 0;   // mm

  void add(const T& weight, const T& x0_here, const T& xi_here, const T& t, const T& b, const T& info,
           double per_unseen) {
    x0 += x0_here;
    xi += xi_here;
    unseen += weight * t;
    slope += weight * b;
    information += weight * info;
    scale += weight * per_unseen;
  }
  void take(mask_of<T> who, const Radiator& other) {
    for (T Radiator::* x : {&Radiator::x0, &Radiator::xi, &Radiator::unseen, &Radiator::slope,
                            &Radiator::information, &Radiator::scale})
      this->*x = select(who, other.*x, this->*x);
    radius = other.radius;
  }
};

// Which slabs are taken together: those that follow each other, until they have enough matter.
inline std::vector<std::int32_t> radiator_of_slabs(const Detector& detector) {
  constexpr double enough = 3e-4, most = 12;  // radiation lengths; number
  double total = 0;
  for (const Slab& slab : detector.slabs) total += slab.x0;
  const double wanted = std::max(enough, total / most);
  std::vector<std::int32_t> number;
  double sum = 0;
  std::int32_t now = 0;
  for (const Slab& slab : detector.slabs) {
    number.push_back(now);
    sum += slab.x0;
    if (sum < wanted) continue;
    sum = 0;
    ++now;
  }
  return number;
}

// Spectra of the losses of electrons in shares y of the energy: photons as in `matter/radiation.hpp`;
// collisions for gamma >> 1, ICRU Report 37, eqs. 2.5 and 2.7, of electrons to 6 %.
template <class T>
struct LossSpectrum {
  T photons, photon_mean,
      photon_square;  // number above y; integrals of y and y^2 up to y, per radiation length
  T collisions;       // number above y, per xi over the energy
  T y, log_y;

  LossSpectrum(const T& per_share, bool electron) : y(1.0 / per_share), log_y(-log(per_share)) {
    const T one = 1.0 - y, square = y * y;
    photons = -4.0 / 3 * (log_y + one) + 0.5 * (1.0 - square);
    photon_mean = mean_below(y);
    photon_square = square * (2.0 / 3 - y * (4.0 / 9 - 0.25 * y));
    if (electron) {
      collisions = larger(per_share - 0.5 - 3.0 * y, 0.0);
    } else {
      collisions =
          per_share - 1.0 + 2.0 * log_y + 3.0 * one - (1.0 - square) + (1.0 - square * y) * (1.0 / 3);
    }
  }
  // As `radiated_mean`.
  static T mean_below(const T& y) { return y * (4.0 / 3 - y * (2.0 / 3 - y * (1.0 / 3))); }
};

// Number, mean and variance of the share that losses between two shares take.
template <class T>
struct LossBin {
  T number, mean, variance;

  LossBin(const LossSpectrum<T>& from, const LossSpectrum<T>& to, const T& x0, const T& xi) {
    // Collisions fall as 1/y^2.
    const T hard = select(from.collisions > 0.0, xi, T(0.0));
    number = x0 * (from.photons - to.photons) + hard * (from.collisions - to.collisions);
    const T per_number = 1.0 / larger(number, 1e-30);
    mean = per_number * (x0 * (to.photon_mean - from.photon_mean) + hard * (to.log_y - from.log_y));
    mean = smaller(larger(mean, from.y), to.y);
    const T square = per_number * (x0 * (to.photon_square - from.photon_square) + hard * (to.y - from.y));
    variance = larger(square - mean * mean, 0.0);
  }
};

// Sums over components: weight, weight times mean, weight times mean square.
template <class T>
struct HypothesisMoments {
  T weight{0.0}, first{0.0}, second{0.0};

  void add(const T& w, const T& mean, const T& variance) {
    weight += w;
    first += w * mean;
    second += w * (variance + mean * mean);
  }
  HypothesisMoments& operator+=(const HypothesisMoments& other) {
    weight += other.weight;
    first += other.first;
    second += other.second;
    return *this;
  }
  // Of the sum of two independent losses.
  friend HypothesisMoments operator*(const HypothesisMoments& a, const HypothesisMoments& b) {
    HypothesisMoments both;
    both.weight = a.weight * b.weight;
    both.first = a.first * b.weight + a.weight * b.first;
    both.second = a.second * b.weight + 2.0 * a.first * b.first + a.weight * b.second;
    return both;
  }
};

// The density of ln(p/p_fit): a sum of normal distributions, the first one without a loss of its own.
template <class T>
struct MomentumDensity {
  static constexpr std::size_t most = density_components;
  std::array<T, most> weight, mean, sigma, per_sigma;
  std::size_t n = 0;

  // Components without weight in any lane are left out.
  void add(const HypothesisMoments<T>& of, const T& shift, const T& variance) {
    const mask_of<T> counts = of.weight > 1e-5;
    if (!any(counts)) return;
    const T per_weight = 1.0 / larger(of.weight, 1e-30), m = of.first * per_weight;
    weight[n] = select(counts, of.weight, T(0.0));  // a lane is as it would be alone
    mean[n] = m + shift;
    sigma[n] = sqrt(larger(of.second * per_weight - m * m, 0.0) + variance);
    per_sigma[n] = 1.0 / sigma[n];
    ++n;
  }
  void normalise() {
    T sum(0.0);
    for (std::size_t i = 0; i < n; ++i) sum += weight[i];
    const T per_sum = 1.0 / sum;
    for (std::size_t i = 0; i < n; ++i) weight[i] *= per_sum;
  }

  // Probability below x, and the density there. Normal distribution: Abramowitz and Stegun, 26.2.17, within
  // 1e-7.
  void at(const T& x, T& below, T& density) const {
    below = density = T(0.0);
    for (std::size_t i = 0; i < n; ++i) {
      const T z = (x - mean[i]) * per_sigma[i], a = abs(z);
      const mask_of<T> near = !(a > far);
      if (!any(near)) {
        below += select(z > 0.0, weight[i], T(0.0));
        continue;
      }
      const T t = 1.0 / (1.0 + 0.2316419 * a), w = smaller(a, 2 * far);
      const T e = select(near, weight[i] * 0.39894228040143267794 * exp(-0.5 * w * w), T(0.0));
      const T tail =
          e * t *
          (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))));
      below += select(z > 0.0, weight[i] - tail, tail);
      density += e * per_sigma[i];
    }
  }

  // The x with this probability below, by Newton's method between bounds.
  T quantile(double probability, T x, T from, T to) const {
    constexpr int steps = 30;
    const double close = 0.02 * std::min(probability, 1 - probability);
    mask_of<T> done(false);
    for (int i = 0; i < steps; ++i) {
      T below, density;
      at(x, below, density);
      const T miss = below - probability, next = x - miss / larger(density, 1e-12);
      from = select(miss < 0.0, x, from);
      to = select(miss < 0.0, to, x);
      x = select(done, x, select((next > from) & (next < to), next, 0.5 * (from + to)));
      done = done | (abs(miss) < close);
      if (all(done)) break;
    }
    return x;
  }
  // A first guess of it: the mean of the component that it is in.
  T guess(double probability) const {
    T x = mean[0] + sigma[0], below = 0.84 * weight[0];
    for (std::size_t i = 1; i < n; ++i) {
      x = select((below < probability) & (weight[i] > 0.0), mean[i], x);
      below += weight[i];
    }
    return larger(x, mean[0] + sigma[0]);
  }

  // The x of the largest density, by steps to the mean that the components give their weights at x for.
  T mode() const {
    constexpr int steps = 8;
    T x = mean[0], best(0.0);
    for (std::size_t i = 0; i < n; ++i) {
      const T height = weight[i] * per_sigma[i];
      x = select(height > best, mean[i], x);
      best = larger(height, best);
    }
    mask_of<T> done(false);
    for (int step = 0; step < steps; ++step) {
      T sum(0.0), weighted(0.0);
      for (std::size_t i = 0; i < n; ++i) {
        const T z = abs(x - mean[i]) * per_sigma[i];
        const mask_of<T> counts = !(z > far);
        if (!any(counts)) continue;
        const T near = smaller(z, 2 * far);
        const T w = select(
            counts, weight[i] * per_sigma[i] * per_sigma[i] * per_sigma[i] * exp(-0.5 * near * near), T(0.0));
        sum += w;
        weighted += w * mean[i];
      }
      const T next = weighted / larger(sum, 1e-300);
      const mask_of<T> close = abs(next - x) < 0.02 * sigma[0];
      x = select(done, x, next);
      done = done | close;
      if (all(done)) break;
    }
    return x;
  }

 private:
  static constexpr double far = 6;  // standard deviations
};

template <class T>
class Breaks {
 public:
  explicit Breaks(const Detector& detector)
      : detector_(detector),
        number_(radiator_of_slabs(detector)),
        radiators_(number_.empty() ? 0 : static_cast<std::size_t>(number_.back()) + 1),
        kept_(radiators_) {}

  // Whether tracks of this kind have a density of their own: others are as good as normal.
  static bool apply(const Detector& detector, Projectile projectile) {
    return projectile >= Projectile::electron && truncates_radiation(detector) && !is_straight(detector.bz);
  }

  // Collects what the hits tell of losses, after the filter. `beam`: measurements before the hits; `helix`:
  // the fitted one; `momentum`: GeV/c.
  CGEMIT_FLATTEN void look(const Group<T>& group, std::span<const Slot<T>> beam, const PerigeeOf<T>& helix,
                           const T& momentum) {
    for (Radiator<T>& one : radiators_) one = {};
    per_energy_ = 1.0 / momentum;
    sec_ = sqrt(1.0 + helix.tanl * helix.tanl);
    straggling_ = T(0.0);
    Five<T> lambda = Five<T>::zero(), row = Five<T>::zero();
    row[2] = 1.0;
    Symmetric<T> information = Symmetric<T>::diagonal(Five<T>::zero());
    for (const Slot<T>& slot : beam) pass(slot, lambda, information, row);
    for (const GroupStep& step : group.steps) {
      for (std::int32_t s = step.first; s < step.last; ++s)
        pass(group.slots[static_cast<std::size_t>(s)], lambda, information, row);
      if (!step.is_slab) continue;
      const auto noise = static_cast<std::size_t>(step.noise);
      Five<T> g;
      if (group.dense) {
        g = group.dense_noise[noise].straggling;
      } else {
        const std::array<T, 4>& of = group.noise[noise].straggling;
        g = {{of[0], of[1], of[2], of[3], T(0.0)}};
      }
      radiate(step.slab, g, helix, lambda, information, row);
    }
    for (Radiator<T>& one : radiators_) {
      const T per_weight = 1.0 / larger(one.x0, 1e-30);
      one.unseen = larger(smaller(one.unseen * per_weight, 1.0), 0.0);
      one.slope *= per_weight;
      one.information = larger(one.information * per_weight, 0.0);
      one.scale *= per_weight;
    }
  }

  // The largest reduction of the chi-square by one break that slows the particle down.
  T best() const {
    T found(0.0);
    for (const Radiator<T>& one : radiators_) {
      const T gain = select(one.slope > 0.0, one.slope * one.slope / (1.0 + one.information), T(0.0));
      found = larger(found, gain);
    }
    return found;
  }

  // Keeps what `look` found for the lanes `who`, in which the fit ends. `variance`: of ln(p) by the filter.
  void keep(mask_of<T> who, const T& variance, const T& tanl, const SpeciesOf<T>& species) {
    for (std::size_t i = 0; i < radiators_.size(); ++i) kept_[i].take(who, radiators_[i]);
    resolved_ = select(who, larger(variance - straggling_, 0.01 * variance), resolved_);
    const KinematicsOf<T> start(1.0 / per_energy_, species);
    cut_ = select(who, light_cut(start, track_matter(detector_, tanl, start)) * per_energy_, cut_);
  }

  // The density of the momentum of the lanes that were kept.
  void weigh(bool electron) {
    const T sigma = sqrt(resolved_);
    edges(sigma);
    for (auto* sums : {&hidden_, &shown_}) sums->fill({});
    T soft(0.0), subtracted(0.0);
    seen_ = radius_ = T(0.0);
    T largest(0.0);
    for (const Radiator<T>& one : kept_) {
      if (!any((one.unseen > least_unseen) & (one.x0 > 0.0))) continue;
      const T shown = weigh(one, electron, soft, subtracted);
      radius_ = select(shown > largest, T(one.radius), radius_);
      largest = larger(shown, largest);
      seen_ += shown;
    }
    combine(resolved_ + soft, subtracted);
    seen_ = seen_ / (1.0 + seen_);
  }

  const MomentumDensity<T>& density() const { return density_; }
  // Probability of a loss that the hits show, and its most probable radius, mm.
  const T& seen() const { return seen_; }
  const T& radius() const { return radius_; }

  // Mode, and limits of 68 and 95 %, of ln(p/p_fit).
  std::array<T, 5> limits() const {
    const T from = density_.mean[0] - 8.0 * density_.sigma[0], to(largest_loss + 1);
    const T& core = density_.mean[0];
    const T& sigma = density_.sigma[0];
    return {density_.mode(), density_.quantile(0.16, core - 0.9 * sigma, from, to),
            density_.quantile(0.84, density_.guess(0.84), from, to),
            density_.quantile(0.025, core - 1.8 * sigma, from, to),
            density_.quantile(0.975, density_.guess(0.975), from, to)};
  }

 private:
  static constexpr int bins = density_bins;
  static constexpr double first_bin = 0.3;      // in sigmas: softer losses have a mean and a variance alone
  static constexpr double largest_loss = 3;     // of ln(p)
  static constexpr double least_unseen = 0.01;  // smaller shares change no momentum
  static constexpr double largest_share = 0.98;

  static void pass(const Slot<T>& slot, Five<T>& lambda, Symmetric<T>& information, Five<T>& row) {
    const T weight = slot.inverse;
    const Five<T> lk = information * slot.ch;
    const T known = dot(slot.ch, lk), away = slot.innovation + dot(slot.ch, lambda);
    lambda = lambda - (weight * away) * slot.row;
    const T gained = weight * (1.0 + weight * known);
    const Five<T> part = weight * lk, rest = gained * slot.row - part;
    information.add([&](auto i, auto j) { return slot.row[i] * rest[j] - part[i] * slot.row[j]; });
    row = row - (weight * dot(row, slot.ch)) * slot.row;
  }

  void radiate(std::int32_t number, const Five<T>& g, const PerigeeOf<T>& helix, const Five<T>& lambda,
               const Symmetric<T>& information, const Five<T>& row) {
    const mask_of<T> crossed = g[2] != 0.0;
    if (!any(crossed)) return;
    const Slab& slab = detector_.slabs[static_cast<std::size_t>(number)];
    const Five<T> u = select(crossed, helix.kappa / g[2], T(0.0)) * g;
    // Sine of the angle between flight and radius, from dS/d(r^2) = w/2 (motion/helix.hpp).
    const double r = slab.radius;
    const T sine =
        (helix.d + 0.5 * curvature(detector_.bz, helix.kappa) * (r * r - helix.d * helix.d)) * (1 / r);
    const T outward = r * sqrt(larger(1.0 - sine * sine, 0.0));
    const T path = select(crossed, path_factor(slab, sec_, outward), T(0.0));
    const T unseen = dot(row, u) / helix.kappa;
    const T relative = dot(row, g) / helix.kappa;
    straggling_ += select(crossed, relative * relative, T(0.0));
    const T x0 = detector_.loss.radiation * slab.x0 * path;
    Radiator<T>& one = radiators_[static_cast<std::size_t>(number_[static_cast<std::size_t>(number)])];
    one.add(x0, x0, slab.xi * per_energy_ * path, unseen, dot(u, lambda), dot(u, information * u),
            slab.per_unseen);
    one.radius = r;
  }

  // Bins of the loss of ln(p) that the fit does not see, each as many times wider than the one before.
  void edges(const T& sigma) {
    const T begin = smaller(first_bin * sigma, 0.1 * largest_loss);
    const T ratio = exp(log(largest_loss / begin) * (1.0 / bins));
    T at = begin;
    for (T& x : per_edge_) {
      x = 1.0 / (1.0 - exp(-at));
      at *= ratio;
    }
  }

  // Adds the losses of a radiator. Returns the weight of those that the hits show.
  T weigh(const Radiator<T>& one, bool electron, T& soft, T& subtracted) {
    const mask_of<T> counts = (one.unseen > least_unseen) & (one.x0 > 0.0);
    const T x0 = select(counts, one.x0, T(0.0)), xi = select(counts, one.xi, T(0.0));
    const T unseen = larger(one.unseen, least_unseen), seen = 1.0 - unseen;
    // One over the share that the loss takes in the slab, if the fit is off by a share.
    const auto per_share = [&](std::size_t k) {
      return larger(unseen * per_edge_[k] + seen, 1 / largest_share);
    };
    LossSpectrum<T> from(per_share(0), electron);
    soft += unseen * unseen * (x0 * from.photon_square + xi * from.y);
    const T highest = smaller(cut_ * one.scale, 1.0), hardest = smaller(highest, electron ? 0.5 : 1.0);
    subtracted += unseen * (x0 * (LossSpectrum<T>::mean_below(highest) - from.photon_mean) +
                            xi * (log(hardest) - from.log_y));
    T shown(0.0);
    for (std::size_t k = 0; k < bins; ++k) {
      const LossSpectrum<T> to(per_share(k + 1), electron);
      const LossBin<T> bin(from, to, x0, xi);
      from = to;
      // The increase of kappa, and its variance.
      const T per = 1.0 / (1.0 - bin.mean * seen), d = bin.mean * per,
              v = bin.variance * (per * per) * (per * per);
      const T known = one.information * d * d;
      const mask_of<T> shows = known > least_known;
      if (!any(shows)) {
        hidden_[k].add(bin.number, unseen * d, unseen * unseen * v);
        continue;
      }
      const T hidden = select(shows, bin.number / (1.0 + known * known), bin.number);
      hidden_[k].add(hidden, unseen * d, unseen * unseen * v);
      const T f = 1.0 / (1.0 + v * one.information);
      const T power = f * (one.slope * d - 0.5 * known + 0.5 * v * one.slope * one.slope);
      const T weight = (bin.number - hidden) * sqrt(f) * exp(smaller(larger(power, -most_power), most_power));
      const T increase = larger(f * (d + v * one.slope), 0.0);
      shown_[k].add(weight, unseen * increase, unseen * unseen * f * v);
      shown += weight;
    }
    return shown;
  }

  // Turns moments of shares x of the momentum into those of -ln(1 - x).
  static void take_logarithm(HypothesisMoments<T>& of) {
    const T per_weight = 1.0 / larger(of.weight, 1e-30), x = smaller(of.first * per_weight, largest_share);
    const T variance = larger(of.second * per_weight - x * x, 0.0), per_left = 1.0 / (1.0 - x);
    const T mean = log(per_left);
    of.first = of.weight * mean;
    of.second = of.weight * (variance * per_left * per_left + mean * mean);
  }

  // Any number of losses that hits do not show, and at most one that they do.
  void combine(const T& core, const T& subtracted) {
    constexpr double half = 0.5;
    for (std::size_t k = 0; k < bins; ++k) {
      take_logarithm(hidden_[k]);
      if (any(shown_[k].weight > 0.0)) take_logarithm(shown_[k]);
    }
    HypothesisMoments<T> none;
    none.weight = T(1.0);
    HypothesisMoments<T> all_hidden = none;  // no loss, or losses up to this bin
    std::array<HypothesisMoments<T>, bins> hidden;
    for (std::size_t k = 0; k < bins; ++k) {
      const HypothesisMoments<T>& one = hidden_[k];
      HypothesisMoments<T> pair = one * one;
      pair.weight *= half;
      pair.first *= half;
      pair.second *= half;
      HypothesisMoments<T> some = one;
      some += pair;
      hidden[k] = all_hidden * some;
      all_hidden += hidden[k];
    }
    density_.n = 0;
    density_.add(none, -subtracted, core);
    HypothesisMoments<T> losses,
        shown = none;  // hidden ones below the bin; none or those shown up to the bin
    for (std::size_t k = 0; k < bins; ++k) {
      const HypothesisMoments<T> pairs = shown_[k] * losses;
      shown += shown_[k];
      HypothesisMoments<T> both = hidden[k] * shown;
      both += pairs;
      density_.add(both, -subtracted, core);
      density_.add(shown_[k], -subtracted, core);
      losses += hidden[k];
    }
    density_.normalise();
  }

  static constexpr double most_power = 500, least_known = 1e-3;

  const Detector& detector_;
  std::vector<std::int32_t> number_;  // of the radiator of each slab
  std::vector<Radiator<T>> radiators_, kept_;
  T per_energy_, sec_;
  T straggling_;  // variance of ln(p) that the fit takes for losses
  // The variance of ln(p) without losses; the fit subtracts the mean of the losses below this share of the
  // energy, times `Radiator::scale`.
  T resolved_{1.0}, cut_{1.0};
  std::array<T, bins + 1> per_edge_;  // one over the share of the momentum
  std::array<HypothesisMoments<T>, bins> hidden_, shown_;
  MomentumDensity<T> density_;
  T seen_, radius_;
};

}  // namespace cgemit

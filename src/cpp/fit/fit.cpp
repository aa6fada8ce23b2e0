#include "fit/fit.hpp"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

#include "common/angles.hpp"
#include "fit/seed.hpp"

namespace cgemit {

namespace {

constexpr int parameters = 5;  // as many measurements can be met by anything: at least one more is asked for
constexpr int patient_iterations = 6;

class TrackFit {
 public:
  TrackFit(const Detector& detector, std::span<const Hit> hits, std::span<const std::int8_t> sides,
           double mass, const FitSettings& settings, FitSpace& space)
      : detector_(detector), hits_(hits), sides_(sides), mass_(mass), settings_(settings), space_(space) {
    space_.value.assign(hits.size(), 0.0);
    space_.variance.assign(hits.size(), 0.0);
    space_.weight.assign(hits.size(), 0.0);
    for (std::size_t i = 0; i < hits.size(); ++i) {
      if (hits[i].view != View::wire) continue;
      space_.weight[i] = sides[i];
      sides_open_ = sides_open_ || sides[i] == 0;
    }
  }

  FitResult run(const Perigee& start, bool wires_first) {
    FitResult result{FitStatus::ok, start, Matrix5::Identity(), 0, 0, 0, 0, 0};
    helix_ = start;
    wires_only_ = wires_first && sides_open_;
    const Vector5 prior = Eigen::Map<const Vector5>(settings_.prior_sigma.data());
    bool converged = false;
    for (int iteration = 0; iteration < settings_.max_iterations && !converged; ++iteration) {
      follow(iteration);
      result.iterations = iteration + 1;
      if (speeds_up(iteration)) continue;
      if (const FitStatus status = usable(); status != FitStatus::ok) return failed(result, status);
      fill_rows();
      const Estimate estimate = filter(space_.reference.elements, prior, space_.memory);
      if (!store(estimate, result)) return failed(result, FitStatus::not_positive_definite);
      const double moved = (estimate.x.cwiseAbs2().array() / estimate.c.diagonal().array()).sqrt().maxCoeff();
      move(estimate.x);
      result.helix = helix_;
      bool settled = true;
      if (sides_open_) {
        smooth(space_.reference.elements, space_.memory);
        settled = renew_sides(iteration);
      }
      converged = moved < settings_.tolerance && settled && !wires_only_;
      wires_only_ = false;
    }
    if (space_.reference.stopped) return failed(result, FitStatus::stopped);  // no iteration was left
    if (!sides_open_) smooth(space_.reference.elements, space_.memory);
    collect_residuals();
    result.status = converged ? FitStatus::ok : FitStatus::not_converged;
    return result;
  }

 private:
  static FitResult failed(FitResult result, FitStatus status) {
    result.status = status;
    return result;
  }

  // A first helix from the outer hits has the momentum that the matter has left over. Where the reference
  // stops on the way to them, it gets more.
  bool speeds_up(int iteration) {
    if (!space_.reference.stopped || iteration >= patient_iterations) return false;
    helix_.kappa *= 0.85;
    return true;
  }

  // Traces the reference. Hits that stay out of its reach are given up after some iterations.
  void follow(int iteration) {
    trace(detector_, helix_, mass_, hits_, space_.reference);
    if (iteration >= patient_iterations) hits_ = hits_.first(space_.reference.reached);
  }

  FitStatus usable() const {
    if (space_.reference.stopped) return FitStatus::stopped;
    return space_.reference.reached <= parameters ? FitStatus::does_not_reach : FitStatus::ok;
  }

  // Residual and variance of every row, on the present reference.
  void fill_rows() {
    for (Element& element : space_.reference.elements) {
      if (!element.is_row) continue;
      const auto i = static_cast<std::size_t>(element.hit);
      const Hit& hit = hits_[i];
      if (hit.view == View::wire) {
        measure_wire(i);
      } else {
        space_.value[i] = hit.value;
        space_.variance[i] = wires_only_ ? 0.0 : cluster_variance(hit, space_.reference.crossings[i].extent);
      }
      element.residual = space_.value[i] - space_.reference.crossings[i].predicted;
      element.variance = space_.variance[i];
    }
  }

  // A drift distance is a mixture of two sides: its mean and variance for the present weight of each.
  void measure_wire(std::size_t i) {
    const double weight = space_.weight[i], drift = hits_[i].value;
    space_.value[i] = weight * drift;
    space_.variance[i] = hits_[i].sigma * hits_[i].sigma + (1 - weight * weight) * drift * drift;
  }

  // A path of projected length w = (m + f) p, p the pitch and 0 <= f < 1, touches m + 1 strips with
  // probability 1 - f or m + 2 with probability f; its centre is uniform in (1 - f) p or f p about theirs. A
  // delta electron (or another particle) adds k strips on one side with probability delta_strips / k, and the
  // centre of all strips is k p / 2 off: the variance is that of the mixture of all that makes as many strips
  // as were seen. Where nothing does, the path lies anywhere in the cluster, or was cut off and lies up to
  // half of what is missing beside.
  double cluster_variance(const Hit& hit, double extent) const {
    if (hit.size == 0 || !settings_.errors_from_track) return hit.sigma * hit.sigma;
    const CgemLayer& layer = detector_.cgem[static_cast<std::size_t>(hit.layer)];
    const double pitch = hit.view == View::x ? layer.pitch_x : layer.pitch_v;
    const double whole = std::floor(extent / pitch), part = extent / pitch - whole;
    const double added = hit.size - 1 - whole;
    const double fewer = (1 - part) * delta_adds(added), more = part * delta_adds(added - 1);
    if (!(fewer + more > 0)) {
      const double anywhere = std::max(std::abs(hit.size * pitch - extent), pitch);
      return anywhere * anywhere / 12;
    }
    const double sum = fewer * spread(added, 1 - part) + more * spread(added - 1, part);
    return pitch * pitch * sum / (fewer + more);
  }

  double delta_adds(double strips) const {
    return strips > 0 ? settings_.delta_strips / strips : (strips == 0 ? 1 : 0);
  }

  // Variance in squared pitches of a position that is uniform in an interval and off by half a strip for each
  // one added.
  double spread(double added, double interval) const {
    const double width = std::max(interval, settings_.least_width);
    return added * added / 4 + width * width / 12;
  }

  bool store(const Estimate& estimate, FitResult& result) const {
    result.covariance = estimate.c;
    result.chi2 = estimate.chi2;
    result.clusters = result.wires = 0;
    for (std::size_t i = 0; i < space_.reference.reached; ++i) {
      if (!(space_.variance[i] > 0)) continue;
      ++(hits_[i].view == View::wire ? result.wires : result.clusters);
    }
    result.measurements = result.clusters + result.wires;
    const Vector5 scale = estimate.c.diagonal();
    if (!estimate.x.allFinite() || !(scale.minCoeff() > 0)) return false;
    const Vector5 inverse = scale.cwiseSqrt().cwiseInverse();
    const Matrix5 correlation = inverse.asDiagonal() * estimate.c * inverse.asDiagonal();
    return Eigen::LLT<Matrix5>(correlation).info() == Eigen::Success;
  }

  // The new reference; a curvature that would more than double or change sign by itself is approached in
  // halves.
  void move(const Vector5& x) {
    const double limit = std::max(0.5 * std::abs(helix_.kappa), 0.2);
    const double fraction = std::min(1.0, limit / std::max(std::abs(x[2]), 1e-12));
    helix_.d += fraction * x[0];
    helix_.psi = wrap_angle(helix_.psi + fraction * x[1]);
    helix_.kappa += fraction * x[2];
    helix_.z0 += fraction * x[3];
    helix_.tanl += fraction * x[4];
    if (helix_.kappa == 0) helix_.kappa = 1e-9;
  }

  // Probability of each side from the track fitted without the hit. True when no weight moved any more.
  bool renew_sides(int iteration) {
    const double caution = iteration < 2 ? 4.0 : 1.0;  // early predictions are worse than they say
    double largest = 0;
    for (std::size_t k = 0; k < space_.reference.elements.size(); ++k) {
      const Element& element = space_.reference.elements[k];
      if (!element.is_row || !(element.variance > 0)) continue;
      const auto i = static_cast<std::size_t>(element.hit);
      const Hit& hit = hits_[i];
      if (hit.view != View::wire || sides_[i] != 0) continue;
      const Filtered& m = space_.memory[k];
      const double predicted = space_.value[i] - m.unbiased;
      const double spread = std::max(m.unbiased_variance - element.variance, 0.0);
      const double variance = hit.sigma * hit.sigma + caution * spread;
      const double weight = std::tanh(hit.value * predicted / variance);
      largest = std::max(largest, std::abs(weight - space_.weight[i]));
      space_.weight[i] = weight;
    }
    return largest < 0.02;
  }

  void collect_residuals() {
    for (std::size_t k = 0; k < space_.reference.elements.size(); ++k) {
      const Element& element = space_.reference.elements[k];
      if (!element.is_row || !(element.variance > 0)) continue;
      const auto i = static_cast<std::size_t>(element.hit);
      const Filtered& m = space_.memory[k];
      const double weight = space_.weight[i];
      space_.residuals[i] = {m.unbiased, std::sqrt(m.unbiased_variance),
                             static_cast<std::int8_t>(weight > 0 ? 1 : (weight < 0 ? -1 : 0))};
    }
  }

  const Detector& detector_;
  std::span<const Hit> hits_;
  std::span<const std::int8_t> sides_;
  double mass_;
  const FitSettings& settings_;
  FitSpace& space_;
  Perigee helix_{};
  bool sides_open_ = false, wires_only_ = false;
};

// Wrong sides or a wrong turn show in the chi-square long before it is unlikely by chance.
bool is_good(const FitResult& result) {
  return result.status == FitStatus::ok && result.chi2 < 5 * result.measurements + 30;
}

bool is_better(const FitResult& a, const FitResult& b) {
  const bool a_fits = a.status == FitStatus::ok, b_fits = b.status == FitStatus::ok;
  return a_fits != b_fits ? a_fits
                          : a.chi2 / std::max(a.measurements, 1) < b.chi2 / std::max(b.measurements, 1);
}

}  // namespace

FitResult fit_track(const Detector& detector, std::span<const Hit> hits, std::span<const std::int8_t> sides,
                    double mass, const Perigee* start, const FitSettings& settings, FitSpace& space) {
  FitResult result{FitStatus::too_few_hits, {}, Matrix5::Identity(), 0, 0, 0, 0, 0};
  space.residuals.assign(hits.size(), {0, 0, 0});
  if (hits.size() <= parameters) return result;
  if (start != nullptr) return TrackFit(detector, hits, sides, mass, settings, space).run(*start, false);
  result.status = FitStatus::seed_failed;
  for (const SeedFrom from : {SeedFrom::wires, SeedFrom::wires_and_clusters, SeedFrom::azimuths}) {
    const auto seed = seed_helix(detector, hits, sides, from);
    if (!seed) continue;
    // A poor seed would let the clusters mislead the sides: the wires settle among themselves first.
    const FitResult next =
        TrackFit(detector, hits, sides, mass, settings, space).run(*seed, from == SeedFrom::wires);
    if (is_good(next)) return next;
    if (result.status == FitStatus::seed_failed || is_better(next, result)) result = next;
  }
  return result;
}

}  // namespace cgemit

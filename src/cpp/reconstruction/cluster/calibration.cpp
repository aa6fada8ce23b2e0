// What a calibration says of a cluster: delays, errors, shares of the estimators, scores of pairs.
#include <algorithm>
#include <cmath>

#include "reconstruction/cluster/charge_time.hpp"

namespace cgemit {

double DelayTable::at(std::size_t layer, int view, double strip_charge) const {
  const std::size_t first = (2 * layer + static_cast<std::size_t>(view)) * points;
  const std::span<const double> q = charge.subspan(first, points), t = delay.subspan(first, points);
  if (strip_charge <= q.front()) return t.front();
  if (strip_charge >= q.back()) return t.back();
  const auto i = static_cast<std::size_t>(std::ranges::upper_bound(q, strip_charge) - q.begin());
  return t[i - 1] + (strip_charge - q[i - 1]) / (q[i] - q[i - 1]) * (t[i] - t[i - 1]);
}

std::size_t Calibration::row(int view, std::size_t layer, double charge) const {
  const std::size_t plane = static_cast<std::size_t>(view) * layers + layer;
  const auto own = edges.subspan(plane * (charges - 1), charges - 1);
  return plane * charges + static_cast<std::size_t>(std::ranges::upper_bound(own, charge) - own.begin());
}

std::size_t Calibration::entry(Estimator which, std::size_t row, std::int32_t size) const {
  const std::size_t at = std::min(static_cast<std::size_t>(size), sizes) - 1;
  return (static_cast<std::size_t>(which) * 2 * layers * charges + row) * sizes + at;
}

double Calibration::error(Estimator which, std::size_t row, std::int32_t size) const {
  return errors[entry(which, row, size)];
}

double Calibration::share(std::size_t row, std::int32_t size) const {
  return shares[row * sizes + std::min(static_cast<std::size_t>(size), sizes) - 1];
}

double PairTable::score(const ClusterRow& x, const ClusterRow& v) const {
  const double* row = &values[static_cast<std::size_t>(x.layer) * entries];
  const auto ratio = [](double value, double mean, double width, double apart) {
    const double near = (value - mean) / width, far = value / apart;
    return 0.5 * (far * far - near * near) + std::log(apart / width);
  };
  const double least = 1e-3;  // fC
  const double clean =
      ratio(std::log(std::max(x.charge, least) / std::max(v.charge, least)), row[0], row[1], row[4]) +
      ratio(x.time - v.time, row[2], row[3], row[5]) + std::log1p(-touched);
  // ln(exp(clean) + touched), for any size of `clean`.
  const double floor = std::log(touched);
  return std::max(clean, floor) + std::log1p(std::exp(-std::abs(clean - floor)));
}

std::size_t SlopeErrors::row(int view, std::size_t layer, double slope, std::int32_t size) const {
  const auto range = std::ranges::upper_bound(edges, std::abs(slope)) - edges.begin();
  const std::size_t plane = static_cast<std::size_t>(view) * layers + layer;
  return (plane * (edges.size() + 1) + static_cast<std::size_t>(range)) * sizes +
         std::min(static_cast<std::size_t>(size), sizes) - 1;
}

double SlopeErrors::error(Estimator which, std::size_t row) const {
  return values[static_cast<std::size_t>(which) * shares.size() + row];
}

double ErrorFactors::of_distance(bool with_angle, Estimator which, std::size_t plane, double distance) const {
  const std::size_t pass = with_angle ? 1 : 0;
  const auto own = edges.subspan((pass * planes + plane) * (ranges - 2), ranges - 2);
  const auto range = distance > 0 ? 1 + (std::ranges::upper_bound(own, distance) - own.begin()) : 0;
  const std::size_t row = (pass * 3 + static_cast<std::size_t>(which)) * planes + plane;
  return apart[row * ranges + static_cast<std::size_t>(range)];
}

namespace {

// Number of the last knot that is not beyond `x`.
std::size_t last_knot(std::span<const double> knots, double x) {
  const auto beyond = static_cast<std::size_t>(std::ranges::upper_bound(knots, x) - knots.begin());
  return beyond > 0 ? beyond - 1 : 0;
}

double between(std::span<const double> knots, std::span<const double> values, double x) {
  const std::size_t i = last_knot(knots, x);
  if (i + 1 == knots.size() || x <= knots[i]) return values[i];
  return values[i] + (x - knots[i]) / (knots[i + 1] - knots[i]) * (values[i + 1] - values[i]);
}

}  // namespace

std::size_t DirectionTable::row(bool of_track, Estimator which, std::size_t plane) const {
  const std::size_t table = (of_track ? 3 : 0) + static_cast<std::size_t>(which);
  return (table * planes + plane) * (slopes.size() + paths.size());
}

double DirectionTable::shift(std::size_t row, Direction direction) const {
  const auto own = depths.subspan(row, slopes.size() + paths.size());
  return direction.slope * (between(slopes, own.first(slopes.size()), std::abs(direction.slope)) +
                            between(paths, own.last(paths.size()), direction.path));
}

double DirectionTable::factor(std::size_t row, Direction direction) const {
  return factors[row + last_knot(slopes, std::abs(direction.slope))] *
         factors[row + slopes.size() + last_knot(paths, direction.path)];
}

}  // namespace cgemit

#include "cluster/charge_time.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

#include "cluster/strip_runs.hpp"
#include "detector/strip_plane.hpp"

namespace cgemit {

namespace {

double mean_charge(std::span<const StripPoint> points) {
  double total = 0;
  for (const StripPoint& point : points) total += point.charge;
  return total / static_cast<double>(points.size());
}

// Variance of a position: one part of all strips, one that falls with the number of electrons.
double weight_of(const StripPoint& point, double mean) { return 1 / (1 + mean / point.charge); }

}  // namespace

Line fit_line_along(std::span<const StripPoint> points, double slope) {
  const double mean = mean_charge(points);
  double s = 0, sum = 0;
  for (const StripPoint& point : points) {
    const double weight = weight_of(point, mean);
    s += weight;
    sum += weight * (point.position - slope * point.height);
  }
  return {sum / s, slope, true};
}

Line fit_line(std::span<const StripPoint> points, double stiffness) {
  const double mean = mean_charge(points);
  double s = 0, sw = 0, sx = 0, sww = 0, swx = 0;
  for (const StripPoint& point : points) {
    const double weight = weight_of(point, mean);
    s += weight;
    sw += weight * point.height;
    sx += weight * point.position;
    sww += weight * point.height * point.height;
    swx += weight * point.height * point.position;
  }
  const double determinant = s * (sww + stiffness) - sw * sw;
  if (points.size() < 3 || !(determinant > 1e-9 * s * s)) return {0, 0, false};
  const double slope = (s * swx - sw * sx) / determinant;
  return {(sx - slope * sw) / s, slope, true};
}

namespace {

constexpr double outside = 0.2;        // mm, by which a strip's height may lie outside the gap
constexpr double least_charge = 1e-3;  // fC

// One view of one layer.
class ViewReconstruction {
 public:
  ViewReconstruction(const CgemLayer& layer, std::size_t number, int view, const ChargeTimeModel& model)
      : layer_(layer),
        number_(number),
        view_(view),
        model_(model),
        timing_(model.layers[number]),
        across_(layer.r_readout * (view == 0 ? 1.0 : layer.cos_stereo)) {}

  // Lorentz shift of electrons from a height above mid-gap to the anode.
  double lorentz(double height) const {
    const double from = std::clamp(layer_.r_mid() + height, layer_.r_gap_in, layer_.r_gap_out);
    return across_ * (timing_.tan_lorentz * std::log(layer_.r_gap_out / from) + timing_.shift);
  }
  // Relative gain at the strip of a digi.
  double gain(const DigiView& digis, std::size_t row) const {
    if (model_.gain.empty()) return 1;
    return model_.gain[static_cast<std::size_t>(gid_of(layer_, digis.sheet[row], view_, digis.strip[row]))];
  }
  // `depth` is added to the heights.
  std::vector<StripPoint> points(const DigiView& digis, StripRun rows, double depth) const {
    const double start = layer_.r_gap_out - layer_.r_mid() + depth;
    std::vector<StripPoint> found;
    for (std::size_t i = 0; i < rows.size(); ++i) {
      const std::size_t row = rows.rows[i];
      const double strip = digis.strip[row] + 0.5, charge = std::max(rows.charge(digis, i), least_charge);
      const double measured = std::max(digis.charge[row], least_charge);
      const double drift = digis.time[row] - timing_.delay - model_.delays.at(number_, view_, measured);
      found.push_back({view_ == 0 ? x_of_strips(layer_, strip) : v_of_strips(layer_, strip),
                       charge / gain(digis, row), start - drift * timing_.velocity});
    }
    return found;
  }
  // Mean time of the charge, ns, without the delay of the chip; `depth` as for `points`.
  double time(std::span<const StripPoint> points, double depth) const {
    const double start = layer_.r_gap_out - layer_.r_mid() + depth;
    double charge = 0, sum = 0;
    for (const StripPoint& point : points) {
      charge += point.charge;
      sum += point.charge * (start - point.height);
    }
    return timing_.delay + sum / charge / timing_.velocity;
  }
  // Slope of the electrons' places of origin as the anode sees them, for a slope of the track.
  double slope_at_anode(double slope) const { return slope - across_ * timing_.tan_lorentz / layer_.r_mid(); }
  // `height`: mean one of the charge.
  double centroid(std::span<const StripPoint> all, double height) const {
    double charge = 0, sum = 0;
    for (const StripPoint& point : all) {
      charge += point.charge;
      sum += point.charge * (point.position - all.front().position);
    }
    return all.front().position + sum / charge - lorentz(height);
  }
  // Line through the strips inside the gap, each moved back by its own Lorentz shift. With a slope it only
  // needs one strip.
  Line line(std::span<const StripPoint> all, std::optional<double> slope) const {
    const double half = layer_.r_gap_out - layer_.r_mid() + outside;
    std::vector<StripPoint> used;
    for (std::size_t i = 0; i < all.size(); ++i) {
      if (std::abs(all[i].height) > half || induced(all, i)) continue;
      used.push_back(all[i]);
      used.back().position += to_border(all, i) - lorentz(all[i].height);
    }
    if (used.size() < (slope ? 1 : 3)) return {0, 0, false};
    const double origin = used.front().position;
    for (StripPoint& point : used) point.position -= origin;
    Line found = slope ? fit_line_along(used, *slope) : fit_line(used, stiffness());
    found.at_middle += origin;
    return found;
  }

 private:
  // Where on an outermost strip its charge is, from the middle: a cloud that hardly reaches the strip has its
  // charge at the border to the neighbour, one with as much charge as the neighbour in the middle.
  double to_border(std::span<const StripPoint> all, std::size_t i) const {
    if (all.size() < 2 || (i != 0 && i + 1 != all.size())) return 0;
    const double pitch = view_ == 0 ? layer_.pitch_x : layer_.pitch_v;
    const double far = 0.5 * pitch * std::max(0.0, 1 - all[i].charge / all[i == 0 ? 1 : i - 1].charge);
    return i == 0 ? far : -far;
  }
  // Slopes of tracks are of the order of 1: a line through strips at nearly one height has none of its own.
  double stiffness() const {
    const double pitch = view_ == 0 ? layer_.pitch_x : layer_.pitch_v;
    return pitch * pitch / 12 / (usual_slope * usual_slope);
  }
  // Whether a strip at the edge has so little charge that its neighbour may have induced it.
  bool induced(std::span<const StripPoint> all, std::size_t i) const {
    if (all.size() < 4 || (i != 0 && i + 1 != all.size())) return false;
    return all[i].charge < model_.edge * all[i == 0 ? 1 : i - 1].charge;
  }

  static constexpr double usual_slope = 1;
  const CgemLayer& layer_;
  std::size_t number_;
  int view_;
  const ChargeTimeModel& model_;
  const LayerTiming& timing_;
  double across_;
};

struct Position {
  double value, error;
};

class ChargeTimeClusters {
 public:
  ChargeTimeClusters(const DigiView& digis, const ChargeTimeModel& model) : digis_(digis), model_(model) {}

  // Whether the strip fired while electrons of the event may have arrived.
  bool keeps(const CgemLayer& layer, std::size_t row) const {
    const auto number = static_cast<std::size_t>(digis_.layer[row]);
    const LayerTiming& timing = model_.layers[number];
    const double charge = std::max(digis_.charge[row], least_charge),
                 drift = digis_.time[row] - timing.delay - model_.delays.at(number, digis_.view[row], charge);
    const double longest = (layer.r_gap_out - layer.r_gap_in) / timing.velocity;
    return drift >= -model_.margin && drift <= longest + model_.margin;
  }

  // Lowest strips between two larger maxima.
  void cuts(const CgemLayer&, std::span<const std::size_t> rows, std::vector<std::size_t>& cuts) const {
    if (!(model_.valley > 0)) return;
    const auto charge = [&](std::size_t i) { return digis_.charge[rows[i]]; };
    std::size_t peak = 0, lowest = 0;  // since the last cut; the lowest one behind the peak
    for (std::size_t i = 1; i < rows.size(); ++i) {
      if (charge(lowest) < model_.valley * std::min(charge(peak), charge(i))) {
        cuts.push_back(lowest);
        peak = lowest = i;
      } else if (charge(i) > charge(peak)) {
        peak = lowest = i;
      } else if (charge(i) < charge(lowest)) {
        lowest = i;
      }
    }
  }

  ClusterRow make(const CgemLayer& layer, StripRun run, std::size_t row) const {
    ClusterRow cluster = row_of_run(layer, digis_, run);
    const int view = static_cast<int>(cluster.view);
    const auto number = static_cast<std::size_t>(cluster.layer);
    const ViewReconstruction plane(layer, number, view, model_);
    double charge = 0;
    for (std::size_t i = 0; i < run.size(); ++i) {
      charge += run.charge(digis_, i) / plane.gain(digis_, run.rows[i]);
    }
    const std::size_t of_charge = model_.calibration.row(view, number, charge);
    const auto points = plane.points(digis_, run, model_.calibration.depth[of_charge]);
    if (!model_.slopes.empty() && row >= model_.slopes.size()) {
      throw std::invalid_argument("slopes: expected one for each cluster");
    }
    const double slope = model_.slopes.empty() ? not_measured : model_.slopes[row];
    Position at = alone(plane, cluster, of_charge, points);
    if (std::isfinite(slope)) {
      const Position along = along_track(plane, cluster, of_charge, points, slope);
      cluster.shift = along.value - at.value;
      at = along;
    }
    cluster.time = plane.time(points, model_.calibration.depth[of_charge]);
    cluster.method = ClusterMethod::positions;
    if (cluster.view == ClusterView::x) {
      cluster.x = at.value;
      cluster.err_x = at.error;
      set_azimuth(layer, cluster);
    } else {
      cluster.v = at.value;
      cluster.err_v = at.error;
    }
    return cluster;
  }

  double score(const ClusterRow& x, const ClusterRow& v) const {
    return model_.pairs.values.empty() ? 0 : model_.pairs.score(x, v);
  }

 private:
  // From the cluster alone.
  Position alone(const ViewReconstruction& plane, const ClusterRow& cluster, std::size_t row,
                 std::span<const StripPoint> points) const {
    const Calibration& from = model_.calibration;
    const double centroid = plane.centroid(points, from.height[row]);
    const Line line = plane.line(points, std::nullopt);
    return merged(centroid, line, from.share(row, cluster.size), [&](Estimator which) {
      return from.error(which, row, cluster.size) *
             model_.factors.of_distance(false, which, number_of(cluster), distance(centroid, line));
    });
  }

  // With the slope of the track that has the cluster.
  Position along_track(const ViewReconstruction& plane, const ClusterRow& cluster, std::size_t of_charge,
                       std::span<const StripPoint> points, double slope) const {
    const SlopeErrors& from = model_.slope_errors;
    const std::size_t row = from.row(static_cast<int>(cluster.view), static_cast<std::size_t>(cluster.layer),
                                     plane.slope_at_anode(slope), cluster.size);
    const double centroid = plane.centroid(points, model_.calibration.height[of_charge]);
    const Line line = plane.line(points, slope);
    return merged(centroid, line, from.shares[row], [&](Estimator which) {
      return from.error(which, row) *
             model_.factors.along[model_.calibration.entry(which, of_charge, cluster.size)] *
             model_.factors.of_distance(true, which, number_of(cluster), distance(centroid, line));
    });
  }
  std::size_t number_of(const ClusterRow& cluster) const {
    return static_cast<std::size_t>(cluster.view) * model_.calibration.layers +
           static_cast<std::size_t>(cluster.layer);
  }
  static double distance(double centroid, const Line& line) {
    return line.good ? std::abs(centroid - line.at_middle) : 0;
  }

  // The position that the estimator selects; the centroid where there is no line.
  template <class Error>
  Position merged(double centroid, const Line& line, double share, Error&& error) const {
    if (model_.estimator == Estimator::centroid || !line.good) return {centroid, error(Estimator::centroid)};
    if (model_.estimator == Estimator::micro_tpc) return {line.at_middle, error(Estimator::micro_tpc)};
    return {share * centroid + (1 - share) * line.at_middle, error(Estimator::merged)};
  }

  const DigiView& digis_;
  const ChargeTimeModel& model_;
};

}  // namespace

ClusterColumns find_charge_time_clusters(const Detector& detector, const DigiView& digis,
                                         const ChargeTimeModel& model) {
  return clusters_of_runs(detector, digis, {model.missing, model.mask}, ChargeTimeClusters(digis, model));
}

}  // namespace cgemit

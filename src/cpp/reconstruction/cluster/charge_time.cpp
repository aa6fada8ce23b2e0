#include "reconstruction/cluster/charge_time.hpp"

#include <algorithm>
#include <cmath>

#include "reconstruction/cluster/strip_runs.hpp"
#include "reconstruction/cluster/view_reconstruction.hpp"

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

struct Measured {
  double value, error;
  Estimator estimator;  // of the value; the error is that of the read-out's one
};

// Of a straight track from the beam line through a place at z.
double slope_at(const CgemLayer& layer, ClusterView view, double z) {
  return view == ClusterView::x ? 0 : -layer.sin_stereo * z / layer.r_mid();
}
double path_at(const CgemLayer& layer, double z) {
  const double rise = z / layer.r_mid();
  return std::sqrt(1 + rise * rise);
}

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
    Measured at = alone(plane, cluster, of_charge, points);
    if (has_track(row)) {
      const Measured along =
          along_track(plane, cluster, of_charge, points, {model_.slopes[row], model_.paths[row]});
      cluster.shift = along.value - at.value;
      at = along;
    }
    cluster.estimator = static_cast<int>(at.estimator);
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

  // Clusters of no known track have the direction of a straight one from the beam line through the place of
  // their best pair.
  void place(const CgemLayer& layer, std::span<ClusterRow> views, std::span<const CrossingPair> pairs,
             std::size_t first) const {
    std::vector<const CrossingPair*> best(views.size(), nullptr);
    for (const CrossingPair& pair : pairs) {
      for (const std::size_t i : {pair.x, pair.v}) {
        if (!best[i] || pair.score > best[i]->score) best[i] = &pair;
      }
    }
    for (std::size_t i = 0; i < views.size(); ++i) {
      if (best[i] && !has_track(first + i)) correct(layer, views[i], best[i]->z);
    }
  }

 private:
  bool has_track(std::size_t row) const {
    return !model_.slopes.empty() && std::isfinite(model_.slopes[row]);
  }

  // For the direction of a track from the beam line.
  void correct(const CgemLayer& layer, ClusterRow& cluster, double z) const {
    const auto number = static_cast<std::size_t>(cluster.layer);
    const ViewReconstruction plane(layer, number, static_cast<int>(cluster.view), model_);
    const double slope = slope_at(layer, cluster.view, z);
    const Direction direction{plane.slope_at_anode(slope), path_at(layer, z)};
    const DirectionTable& from = model_.directions;
    const std::size_t plane_number = number_of(cluster);
    const double shift =
        from.shift(from.row(false, static_cast<Estimator>(cluster.estimator), plane_number), direction);
    const double factor = from.factor(from.row(false, model_.estimator, plane_number), direction);
    cluster.shift -= shift;
    if (cluster.view == ClusterView::x) {
      cluster.x -= shift;
      cluster.err_x *= factor;
      set_azimuth(layer, cluster);
    } else {
      cluster.v -= shift;
      cluster.err_v *= factor;
    }
  }

  // From the cluster alone.
  Measured alone(const ViewReconstruction& plane, const ClusterRow& cluster, std::size_t row,
                 std::span<const StripPoint> points) const {
    const Calibration& from = model_.calibration;
    const double centroid = plane.centroid(points, from.height[row]);
    const Line line = plane.line(points, std::nullopt);
    Measured found = merged(centroid, line, from.share(row, cluster.size));
    found.error =
        from.error(model_.estimator, row, cluster.size) *
        model_.factors.of_distance(false, model_.estimator, number_of(cluster), distance(centroid, line));
    return found;
  }

  // With the direction of the track that has the cluster.
  Measured along_track(const ViewReconstruction& plane, const ClusterRow& cluster, std::size_t of_charge,
                       std::span<const StripPoint> points, Direction track) const {
    const SlopeErrors& from = model_.slope_errors;
    const Direction direction{plane.slope_at_anode(track.slope), track.path};
    const std::size_t row = from.row(static_cast<int>(cluster.view), static_cast<std::size_t>(cluster.layer),
                                     direction.slope, cluster.size);
    const double centroid = plane.centroid(points, model_.calibration.height[of_charge]);
    const Line line = plane.line(points, track.slope);
    const std::size_t number = number_of(cluster);
    const DirectionTable& directions = model_.directions;
    Measured found = merged(centroid, line, from.shares[row]);
    found.value -= directions.shift(directions.row(true, found.estimator, number), direction);
    found.error = from.error(model_.estimator, row) *
                  model_.factors.along[model_.calibration.entry(model_.estimator, of_charge, cluster.size)] *
                  model_.factors.of_distance(true, model_.estimator, number, distance(centroid, line)) *
                  directions.factor(directions.row(true, model_.estimator, number), direction);
    return found;
  }
  std::size_t number_of(const ClusterRow& cluster) const {
    return static_cast<std::size_t>(cluster.view) * model_.calibration.layers +
           static_cast<std::size_t>(cluster.layer);
  }
  static double distance(double centroid, const Line& line) {
    return line.good ? std::abs(centroid - line.at_middle) : 0;
  }

  // The position that the estimator selects, without its error; the centroid where there is no line.
  Measured merged(double centroid, const Line& line, double share) const {
    const Estimator which = line.good ? model_.estimator : Estimator::centroid;
    const double line_share = which == Estimator::centroid    ? 0
                              : which == Estimator::micro_tpc ? 1
                                                              : 1 - share;
    const double value = line_share > 0 ? centroid + line_share * (line.at_middle - centroid) : centroid;
    return {value, not_measured, which};
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

#include "cluster/charge_time.hpp"

#include <algorithm>
#include <cmath>

#include "cluster/strip_runs.hpp"
#include "detector/strip_plane.hpp"

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

double Calibration::error(Estimator which, std::size_t row, std::int32_t size) const {
  const std::size_t at = std::min(static_cast<std::size_t>(size), sizes) - 1;
  return errors[(static_cast<std::size_t>(which) * 2 * layers * charges + row) * sizes + at];
}

Line fit_line(std::span<const StripPoint> points) {
  double total = 0;
  for (const StripPoint& point : points) total += point.charge;
  const double mean = total / static_cast<double>(points.size());
  double s = 0, sw = 0, sx = 0, sww = 0, swx = 0;
  for (const StripPoint& point : points) {
    const double ratio = mean / point.charge, weight = 1 / (1 + ratio * ratio);
    s += weight;
    sw += weight * point.height;
    sx += weight * point.position;
    sww += weight * point.height * point.height;
    swx += weight * point.height * point.position;
  }
  const double determinant = s * sww - sw * sw;
  if (points.size() < 3 || !(determinant > 1e-9 * s * s)) return {0, 0, false};
  const double slope = (s * swx - sw * sx) / determinant;
  return {(sx - slope * sw) / s, slope, true};
}

namespace {

constexpr double outside = 0.2;  // mm, by which a strip's height may lie outside the gap

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
    for (const std::size_t row : rows) {
      const double strip = digis.strip[row] + 0.5, charge = std::max(digis.charge[row], least_charge);
      const double drift = digis.time[row] - timing_.delay - model_.delays.at(number_, view_, charge);
      found.push_back({view_ == 0 ? x_of_strips(layer_, strip) : v_of_strips(layer_, strip),
                       charge / gain(digis, row), start - drift * timing_.velocity});
    }
    return found;
  }
  // `height`: mean one of the charge.
  double centroid(std::span<const StripPoint> all, double height) const {
    double charge = 0, sum = 0;
    for (const StripPoint& point : all) {
      charge += point.charge;
      sum += point.charge * (point.position - all.front().position);
    }
    return all.front().position + sum / charge - lorentz(height);
  }
  // Line through the strips inside the gap, each moved back by its own Lorentz shift.
  Line line(std::span<const StripPoint> all) const {
    const double half = layer_.r_gap_out - layer_.r_mid() + outside;
    std::vector<StripPoint> used;
    for (std::size_t i = 0; i < all.size(); ++i) {
      if (std::abs(all[i].height) > half || induced(all, i)) continue;
      used.push_back(all[i]);
      used.back().position -= lorentz(all[i].height);
    }
    if (used.size() < 3) return {0, 0, false};
    const double origin = used.front().position;
    for (StripPoint& point : used) point.position -= origin;
    Line found = fit_line(used);
    found.at_middle += origin;
    return found;
  }

 private:
  // Whether a strip at the edge has so little charge that its neighbour may have induced it.
  bool induced(std::span<const StripPoint> all, std::size_t i) const {
    if (all.size() < 4 || (i != 0 && i + 1 != all.size())) return false;
    return all[i].charge < model_.edge * all[i == 0 ? 1 : i - 1].charge;
  }

  static constexpr double least_charge = 1e-3;  // fC
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

Position position_of(const ViewReconstruction& view, const Calibration& calibration, std::size_t row,
                     std::int32_t size, std::span<const StripPoint> points, Estimator estimator) {
  const auto error = [&](Estimator which) { return calibration.error(which, row, size); };
  const double centroid = view.centroid(points, calibration.height[row]);
  const double centroid_error = error(Estimator::centroid);
  if (estimator == Estimator::centroid) return {centroid, centroid_error};
  const Line line = view.line(points);
  if (!line.good) return {centroid, centroid_error};
  const double line_error = error(Estimator::micro_tpc);
  if (estimator == Estimator::micro_tpc) return {line.at_middle, line_error};
  const double a = 1 / (centroid_error * centroid_error), b = 1 / (line_error * line_error);
  return {(a * centroid + b * line.at_middle) / (a + b), error(Estimator::merged)};
}

}  // namespace

ClusterColumns find_charge_time_clusters(const Detector& detector, const DigiView& digis,
                                         const ChargeTimeModel& model) {
  return clusters_of_runs(
      detector, digis, {model.missing, model.mask}, [&](const CgemLayer& layer, StripRun rows) {
        ClusterRow cluster = row_of_run(layer, digis, rows);
        const ViewReconstruction view(layer, static_cast<std::size_t>(cluster.layer),
                                      static_cast<int>(cluster.view), model);
        double charge = 0;
        for (const std::size_t digi : rows) charge += digis.charge[digi] / view.gain(digis, digi);
        const std::size_t row = model.calibration.row(static_cast<int>(cluster.view),
                                                      static_cast<std::size_t>(cluster.layer), charge);
        const auto points = view.points(digis, rows, model.calibration.depth[row]);
        const Position at = position_of(view, model.calibration, row, cluster.size, points, model.estimator);
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
      });
}

}  // namespace cgemit

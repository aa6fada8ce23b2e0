#include "reconstruction/cluster/positions.hpp"

#include <cmath>

namespace cgemit {
namespace {

void check(const Detector& detector, const DigiView& digis) {
  for (std::size_t i = 0; i < digis.size(); ++i) {
    checked_layer(detector, digis, i);
    if (!std::isfinite(digis.position[i])) {
      throw std::invalid_argument("digis row " + std::to_string(i) +
                                  ": the position is not finite, expected one in mm");
    }
  }
}

ClusterRow make_cluster(const MeasuringLayer& layer, const DigiView& digis, std::size_t row,
                        const PositionErrors& errors) {
  ClusterRow cluster{digis.event[row], digis.layer[row], digis.sheet[row], ClusterView{digis.view[row]}};
  cluster.charge = digis.charge[row];
  cluster.time = digis.time[row];
  cluster.r = layer.r_mid();
  cluster.truth = digis.truth[row];
  cluster.n_truths = digis.n_truths[row];
  cluster.method = ClusterMethod::positions;
  if (cluster.view == ClusterView::x) {
    cluster.x = digis.position[row] - layer.lorentz_shift;
    cluster.err_x = errors.sigma_x;
    set_azimuth(layer, cluster);
  } else {
    cluster.v = digis.position[row] - layer.lorentz_shift * layer.cos_stereo;
    cluster.err_v = errors.sigma_v;
  }
  return cluster;
}

// The clusters of one sheet: `views` holds its X clusters, then its V clusters.
void write_sheet(const MeasuringLayer& layer, std::span<const ClusterRow> views,
                 Columns<ClusterRow>& clusters) {
  const auto n_x = static_cast<std::size_t>(
      std::ranges::count(views, ClusterView::x, [](const ClusterRow& row) { return row.view; }));
  if (!layer.has_x || !layer.has_v) {
    for (const ClusterRow& cluster : views) clusters.push_back(cluster);
    return;
  }
  if (views.size() != 2 * n_x) {
    const ClusterRow& at = views.front();
    throw std::invalid_argument("digis of event " + std::to_string(at.event) + ", layer " +
                                std::to_string(at.layer) + ", sheet " + std::to_string(at.sheet) + ": " +
                                std::to_string(n_x) + " positions in X and " +
                                std::to_string(views.size() - n_x) + " in V, expected as many");
  }
  const auto first = static_cast<std::int64_t>(clusters.size()), pairs = static_cast<std::int64_t>(n_x);
  for (const ClusterRow& cluster : views) clusters.push_back(cluster);
  for (std::int64_t k = 0; k < pairs; ++k) {
    const auto at = static_cast<std::size_t>(k);
    clusters.push_back(join_views(layer, views[at], views[at + n_x], first + k, first + pairs + k));
  }
}

}  // namespace

Columns<ClusterRow> clusters_of_positions(const Detector& detector, const DigiView& digis,
                                          std::span<const PositionErrors> errors) {
  check(detector, digis);
  const std::vector<std::size_t> order = by_place(digis);
  Columns<ClusterRow> clusters;
  clusters.reserve(3 * digis.size() / 2);
  std::vector<ClusterRow> sheet;
  for (std::size_t i = 0; i < order.size(); ++i) {
    const std::size_t row = order[i];
    const auto index = static_cast<std::size_t>(digis.layer[row]);
    const MeasuringLayer& layer = detector.layers[index];
    sheet.push_back(make_cluster(layer, digis, row, errors[index]));
    if (i + 1 < order.size() && digis.sheet_of(order[i + 1]) == digis.sheet_of(row)) continue;
    write_sheet(layer, sheet, clusters);
    sheet.clear();
  }
  return clusters;
}

}  // namespace cgemit

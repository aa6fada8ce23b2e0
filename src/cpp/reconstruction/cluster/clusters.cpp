#include "reconstruction/cluster/clusters.hpp"

#include "reconstruction/cluster/strip_runs.hpp"

namespace cgemit {
namespace {

// Position across the strips, in strips. The charge-weighted position of strips without charge is the
// geometric centre.
double across(const DigiView& digis, StripRun rows, Position position) {
  const std::int32_t first = digis.strip[rows.front()];
  double mean = 0.5 * (digis.strip[rows.back()] - first);
  if (position == Position::charge) {
    double sum = 0, weighted = 0;
    for (const std::size_t row : rows) {
      sum += digis.charge[row];
      weighted += digis.charge[row] * (digis.strip[row] - first);
    }
    if (sum > 0) mean = weighted / sum;
  }
  return first + mean + 0.5;
}

// The cluster of one view made of the digis `rows`, ordered by strip.
ClusterRow make_cluster(const MeasuringLayer& layer, const DigiView& digis, StripRun rows,
                        const ErrorTable& errors, Position position) {
  ClusterRow cluster = row_of_run(layer, digis, rows);
  if (cluster.view == ClusterView::x) {
    cluster.x = x_of_strips(layer, across(digis, rows, position)) - layer.lorentz_shift;
    cluster.err_x = errors.of(errors.x, cluster.layer, cluster.size);
    set_azimuth(layer, cluster);
  } else {
    cluster.v = v_of_strips(layer, across(digis, rows, position)) - layer.lorentz_shift * layer.cos_stereo;
    cluster.err_v = errors.of(errors.v, cluster.layer, cluster.size);
  }
  return cluster;
}

struct BinaryClusters {
  const DigiView& digis;
  const ErrorTable& errors;
  Position position;

  void cuts(const MeasuringLayer&, std::span<const std::size_t>, std::vector<std::size_t>&) const {}
  ClusterRow make(const MeasuringLayer& layer, StripRun rows, std::size_t) const {
    return make_cluster(layer, digis, rows, errors, position);
  }
  double score(const MeasuringLayer&, std::span<const ClusterRow>, std::size_t, std::size_t, double) const {
    return 0;
  }
};

}  // namespace

Columns<ClusterRow> find_clusters(const Detector& detector, const DigiView& digis, const ErrorTable& errors,
                                  Position position, const StripMask& mask) {
  return clusters_of_runs(detector, digis, {0, mask}, BinaryClusters{digis, errors, position});
}

}  // namespace cgemit

#include "cluster/clusters.hpp"

#include <algorithm>
#include <tuple>

namespace cgemit {
namespace {

using Rows = std::span<const std::size_t>;

void check(const DigiView& digis, const Detector& detector) {
  for (std::size_t i = 0; i < digis.size(); ++i) {
    const CgemLayer& layer = checked_layer(detector, digis, i);
    expect(i, "strip", digis.strip[i], digis.view[i] == 0 ? layer.strips_x : layer.strips_v);
  }
}

// The truth with most of the cluster's charge, from the largest truth that each digi names.
std::int64_t largest_truth(const DigiView& digis, Rows rows) {
  std::int64_t largest = digis.truth[rows.front()];
  double most = -1;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    double charge = 0;
    for (const std::size_t row : rows)
      charge += digis.truth[row] == digis.truth[rows[i]] ? digis.charge[row] : 0;
    if (charge > most) {
      most = charge;
      largest = digis.truth[rows[i]];
    }
  }
  return largest;
}

// Lower limit of the number of truths: from the counts of the digis, and the distinct truths they name.
std::int32_t count_truths(const DigiView& digis, Rows rows) {
  std::int32_t most = 0, distinct = 0;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const auto same = [&](std::size_t row) { return digis.truth[row] == digis.truth[rows[i]]; };
    most = std::max(most, digis.n_truths[rows[i]]);
    distinct += std::none_of(rows.begin(), rows.begin() + static_cast<std::ptrdiff_t>(i), same);
  }
  return std::max(most, distinct);
}

// Position across the strips, in strips. The charge-weighted position of strips without charge is the
// geometric centre.
double across(const DigiView& digis, Rows rows, Position position) {
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
ClusterRow make_cluster(const CgemLayer& layer, const DigiView& digis, Rows rows, const ErrorTable& errors,
                        Position position) {
  const std::size_t front = rows.front();
  ClusterRow cluster{digis.event[front], digis.layer[front], digis.sheet[front],
                     ClusterView{digis.view[front]}};
  cluster.first = digis.strip[front];
  cluster.last = digis.strip[rows.back()];
  cluster.size = cluster.last - cluster.first + 1;
  cluster.time = digis.time[front];
  for (const std::size_t row : rows) {
    cluster.charge += digis.charge[row];
    cluster.time = std::min(cluster.time, digis.time[row]);
  }
  cluster.r = layer.r_mid();
  cluster.truth = largest_truth(digis, rows);
  cluster.n_truths = count_truths(digis, rows);
  if (cluster.view == ClusterView::x) {
    cluster.x = x_of_strips(layer, across(digis, rows, position));
    cluster.err_x = errors.of(errors.x, cluster.layer, cluster.size);
    set_azimuth(layer, cluster);
  } else {
    cluster.v = v_of_strips(layer, across(digis, rows, position));
    cluster.err_v = errors.of(errors.v, cluster.layer, cluster.size);
  }
  return cluster;
}

// Writes the clusters of one sheet: `views` holds its X clusters, then its V clusters.
void write_sheet(const CgemLayer& layer, std::span<const ClusterRow> views, ClusterColumns& clusters) {
  const std::int64_t first = clusters.rows();
  for (const ClusterRow& cluster : views) clusters.push_back(cluster);
  for (std::size_t i = 0; i < views.size() && views[i].view == ClusterView::x; ++i) {
    for (std::size_t k = i + 1; k < views.size(); ++k) {
      if (views[k].view != ClusterView::v ||
          std::abs(crossing_z(layer, views[i].x, views[k].v)) > layer.half_length)
        continue;
      clusters.push_back(join_views(layer, views[i], views[k], first + static_cast<std::int64_t>(i),
                                    first + static_cast<std::int64_t>(k)));
    }
  }
}

// Neighbouring strips (or the same one twice) of one view and sheet belong together.
bool adjacent(const DigiView& digis, std::size_t a, std::size_t b) {
  return digis.strip[b] <= digis.strip[a] + 1 && digis.view[a] == digis.view[b] &&
         digis.sheet_of(a) == digis.sheet_of(b);
}

}  // namespace

ClusterColumns find_clusters(const Detector& detector, const DigiView& digis, const ErrorTable& errors,
                             Position position) {
  check(digis, detector);
  const std::vector<std::size_t> order = by_place(digis);
  ClusterColumns clusters;
  clusters.reserve(digis.size());
  std::vector<ClusterRow> sheet;
  const auto flush = [&] {
    if (sheet.empty()) return;
    write_sheet(detector.cgem[static_cast<std::size_t>(sheet.front().layer)], sheet, clusters);
    sheet.clear();
  };
  for (std::size_t begin = 0, end; begin < order.size(); begin = end) {
    end = begin + 1;
    while (end < order.size() && adjacent(digis, order[end - 1], order[end])) ++end;
    const CgemLayer& layer = detector.cgem[static_cast<std::size_t>(digis.layer[order[begin]])];
    ClusterRow cluster =
        make_cluster(layer, digis, Rows(order).subspan(begin, end - begin), errors, position);
    const auto on = [](const ClusterRow& c) { return std::tuple(c.event, c.layer, c.sheet); };
    if (!sheet.empty() && on(sheet.front()) != on(cluster)) flush();
    sheet.push_back(cluster);
  }
  flush();
  return clusters;
}

}  // namespace cgemit

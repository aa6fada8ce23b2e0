// Runs of contiguous fired strips, and the clusters that they become: shared by the read-outs with strips.
#pragma once

#include <algorithm>
#include <cmath>
#include <span>
#include <tuple>
#include <vector>

#include "cluster/digis.hpp"
#include "detector/cluster_rows.hpp"
#include "detector/strip_maps.hpp"

namespace cgemit {

// Rows of the digis of one cluster, ordered by strip.
using StripRun = std::span<const std::size_t>;

inline void check(const DigiView& digis, const Detector& detector) {
  for (std::size_t i = 0; i < digis.size(); ++i) {
    const CgemLayer& layer = checked_layer(detector, digis, i);
    expect(i, "strip", digis.strip[i], digis.view[i] == 0 ? layer.strips_x : layer.strips_v);
  }
}

// The truth with most of the cluster's charge, from the largest truth that each digi names.
inline std::int64_t largest_truth(const DigiView& digis, StripRun rows) {
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
inline std::int32_t count_truths(const DigiView& digis, StripRun rows) {
  std::int32_t most = 0, distinct = 0;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const auto same = [&](std::size_t row) { return digis.truth[row] == digis.truth[rows[i]]; };
    most = std::max(most, digis.n_truths[rows[i]]);
    distinct += std::none_of(rows.begin(), rows.begin() + static_cast<std::ptrdiff_t>(i), same);
  }
  return std::max(most, distinct);
}

// The row of one view made of the digis `rows`: all but its position and errors.
inline ClusterRow row_of_run(const CgemLayer& layer, const DigiView& digis, StripRun rows) {
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
  return cluster;
}

// Writes the clusters of one sheet: `views` holds its X clusters, then its V clusters.
inline void write_sheet(const CgemLayer& layer, std::span<const ClusterRow> views, ClusterColumns& clusters) {
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

// What joins strips to clusters: how many strips may be missing within one, and which never fire usefully.
struct Joining {
  std::int32_t missing = 0;
  StripMask mask = {};
};

inline int gid_of_row(const Detector& detector, const DigiView& digis, std::size_t row) {
  return gid_of(detector.cgem[static_cast<std::size_t>(digis.layer[row])], digis.sheet[row], digis.view[row],
                digis.strip[row]);
}

// Whether strips (or the same one twice) of one view and sheet belong together.
inline bool adjacent(const Detector& detector, const DigiView& digis, std::size_t a, std::size_t b,
                     const Joining& joining) {
  return digis.view[a] == digis.view[b] && digis.sheet_of(a) == digis.sheet_of(b) &&
         joining.mask.joins(gid_of_row(detector, digis, a), gid_of_row(detector, digis, b), joining.missing);
}

// Grows the error of a cluster that masked strips have truncated or interrupted: each masked strip within it
// or next to it may have had charge, which adds the variance of a position anywhere on that strip.
inline void widen(const CgemLayer& layer, const StripMask& mask, ClusterRow& cluster) {
  if (mask.is_empty()) return;
  const bool is_x = cluster.view == ClusterView::x;
  const int view = is_x ? 0 : 1, strips = is_x ? layer.strips_x : layer.strips_v;
  const int masked = mask.count(gid_of(layer, cluster.sheet, view, std::max(cluster.first - 1, 0)),
                                gid_of(layer, cluster.sheet, view, std::min(cluster.last + 1, strips - 1)));
  if (masked == 0) return;
  const double more = (is_x ? layer.pitch_x : layer.pitch_v) * std::sqrt(masked / 12.0);
  double& error = is_x ? cluster.err_x : cluster.err_v;
  error = std::hypot(error, more);
  if (is_x) set_azimuth(layer, cluster);
  cluster.method = ClusterMethod::positions;  // the fit keeps this error
}

// Clusters of all digis: `make` gives that of a run of strips. Rows ordered by event, layer, sheet, then X, V
// and XV clusters. Digis of masked strips are left out.
template <class Make>
ClusterColumns clusters_of_runs(const Detector& detector, const DigiView& digis, const Joining& joining,
                                Make&& make) {
  check(digis, detector);
  std::vector<std::size_t> order = by_place(digis);
  if (!joining.mask.is_empty()) {
    std::erase_if(order, [&](std::size_t row) { return joining.mask(gid_of_row(detector, digis, row)); });
  }
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
    while (end < order.size() && adjacent(detector, digis, order[end - 1], order[end], joining)) ++end;
    const CgemLayer& layer = detector.cgem[static_cast<std::size_t>(digis.layer[order[begin]])];
    ClusterRow cluster = make(layer, StripRun(order).subspan(begin, end - begin));
    widen(layer, joining.mask, cluster);
    const auto on = [](const ClusterRow& c) { return std::tuple(c.event, c.layer, c.sheet); };
    if (!sheet.empty() && on(sheet.front()) != on(cluster)) flush();
    sheet.push_back(cluster);
  }
  flush();
  return clusters;
}

}  // namespace cgemit

// Runs of contiguous fired strips, and the clusters that they become: shared by the readouts with strips.
#pragma once

#include <algorithm>
#include <cmath>
#include <span>
#include <tuple>
#include <type_traits>
#include <vector>

#include "readout/cluster_rows.hpp"
#include "readout/strip_maps.hpp"
#include "reconstruction/cluster/digis.hpp"

namespace cgemit {

// Rows of the digis of one cluster, ordered by strip. A strip in the valley between two clusters gives half
// of its charge to each.
struct StripRun {
  std::span<const std::size_t> rows;
  bool shares_first = false, shares_last = false;

  std::size_t size() const { return rows.size(); }
  std::size_t front() const { return rows.front(); }
  std::size_t back() const { return rows.back(); }
  auto begin() const { return rows.begin(); }
  auto end() const { return rows.end(); }
  double charge(const DigiView& digis, std::size_t i) const {
    const bool shared = (shares_first && i == 0) || (shares_last && i + 1 == rows.size());
    return (shared ? 0.5 : 1.0) * digis.charge[rows[i]];
  }
};

inline void check(const DigiView& digis, const Detector& detector) {
  for (std::size_t i = 0; i < digis.size(); ++i) {
    const MeasuringLayer& layer = checked_layer(detector, digis, i);
    expect(i, "strip", digis.strip[i], digis.view[i] == 0 ? layer.strips_x : layer.strips_v);
  }
}

inline bool of_one_truth(const DigiView& digis, StripRun rows) {
  const std::int64_t truth = digis.truth[rows.front()];
  return std::ranges::all_of(rows, [&](std::size_t row) { return digis.truth[row] == truth; });
}

// The truth with most of the cluster's charge, from the largest truth that each digi names.
inline std::int64_t largest_truth(const DigiView& digis, StripRun rows) {
  std::int64_t largest = digis.truth[rows.front()];
  double most = -1;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const std::int64_t truth = digis.truth[rows.rows[i]];
    double charge = 0;
    for (std::size_t k = 0; k < rows.size(); ++k)
      charge += digis.truth[rows.rows[k]] == truth ? rows.charge(digis, k) : 0;
    if (charge > most) {
      most = charge;
      largest = truth;
    }
  }
  return largest;
}

// Lower limit of the number of truths: from the counts of the digis, and the distinct truths they name.
inline std::int32_t count_truths(const DigiView& digis, StripRun rows) {
  std::int32_t most = 0, distinct = 0;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const auto same = [&](std::size_t row) { return digis.truth[row] == digis.truth[rows.rows[i]]; };
    most = std::max(most, digis.n_truths[rows.rows[i]]);
    distinct += std::none_of(rows.begin(), rows.begin() + static_cast<std::ptrdiff_t>(i), same);
  }
  return std::max(most, distinct);
}

// The row of one view made of the digis `rows`: all but its position and errors.
inline ClusterRow row_of_run(const MeasuringLayer& layer, const DigiView& digis, StripRun rows) {
  const std::size_t front = rows.front();
  ClusterRow cluster{digis.event[front], digis.layer[front], digis.sheet[front],
                     ClusterView{digis.view[front]}};
  cluster.first = digis.strip[front];
  cluster.last = digis.strip[rows.back()];
  cluster.size = cluster.last - cluster.first + 1;
  cluster.time = digis.time[front];
  for (std::size_t i = 0; i < rows.size(); ++i) {
    cluster.charge += rows.charge(digis, i);
    cluster.time = std::min(cluster.time, digis.time[rows.rows[i]]);
  }
  cluster.r = layer.r_mid();
  if (of_one_truth(digis, rows)) {
    cluster.truth = digis.truth[front];
    for (const std::size_t row : rows) cluster.n_truths = std::max(cluster.n_truths, digis.n_truths[row]);
    cluster.n_truths = std::max(cluster.n_truths, 1);
  } else {
    cluster.truth = largest_truth(digis, rows);
    cluster.n_truths = count_truths(digis, rows);
  }
  return cluster;
}

// X and V clusters of a sheet that cross on it: their numbers, where, and how well they fit each other.
struct CrossingPair {
  std::size_t x, v;
  double z, score;
};

// All pairs of one sheet: `views` holds its X clusters, then its V clusters.
template <class Model>
void find_pairs(const MeasuringLayer& layer, std::span<const ClusterRow> views, Model& model,
                std::vector<CrossingPair>& pairs) {
  pairs.clear();
  for (std::size_t i = 0; i < views.size() && views[i].view == ClusterView::x; ++i) {
    for (std::size_t k = i + 1; k < views.size(); ++k) {
      if (views[k].view != ClusterView::v) continue;
      const double z = crossing_z(layer, views[i].x - views[i].shift, views[k].v - views[k].shift);
      if (!layer.ends.miss(z)) pairs.push_back({i, k, z, model.score(layer, views, i, k, z)});
    }
  }
}

// Writes the clusters of one sheet and their pairs.
inline void write_sheet(const MeasuringLayer& layer, std::span<const ClusterRow> views,
                        std::span<const CrossingPair> pairs, Columns<ClusterRow>& clusters) {
  const auto first = static_cast<std::int64_t>(clusters.size());
  for (const ClusterRow& cluster : views) clusters.push_back(cluster);
  for (const CrossingPair& pair : pairs) {
    clusters.push_back(join_views(layer, views[pair.x], views[pair.v],
                                  first + static_cast<std::int64_t>(pair.x),
                                  first + static_cast<std::int64_t>(pair.v), pair.score));
  }
}

// What joins strips to clusters: how many strips may be missing within one, and which never fire usefully.
struct Joining {
  std::int32_t missing = 0;
  StripMask mask = {};
};

inline int gid_of_row(const Detector& detector, const DigiView& digis, std::size_t row) {
  return gid_of(detector.layers[static_cast<std::size_t>(digis.layer[row])], digis.sheet[row],
                digis.view[row], digis.strip[row]);
}

// Whether strips (or the same one twice) of one view and sheet belong together.
inline bool adjacent(const Detector& detector, const DigiView& digis, std::size_t a, std::size_t b,
                     const Joining& joining) {
  return digis.view[a] == digis.view[b] && digis.sheet_of(a) == digis.sheet_of(b) &&
         joining.mask.joins(gid_of_row(detector, digis, a), gid_of_row(detector, digis, b), joining.missing);
}

// Grows the error of a cluster that masked strips have truncated or interrupted: each masked strip within it
// or next to it may have had charge, which adds the variance of a position anywhere on that strip.
inline void widen(const MeasuringLayer& layer, const StripMask& mask, ClusterRow& cluster) {
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

// Clusters of all digis. A model has
//   cuts(layer, rows, cuts): appends the numbers, within a run of strips, of those at which it falls apart;
//   make(layer, run, row): the cluster of a run, which will be this row of the table;
//   score(layer, views, i, k, z): how well two clusters of a sheet that cross at z fit each other;
//   place(layer, views, pairs, first): changes clusters of a sheet, of which the first will be this row of
//   the table, for where their pairs cross (without it, they stay); keeps(layer, row): whether a digi may be
//   of a particle (without it, all may); knows_lost_charge: if its errors count masked strips.
// Rows ordered by event, layer, sheet, then X, V and XV clusters. Digis of masked strips are left out.
template <class Model>
Columns<ClusterRow> clusters_of_runs(const Detector& detector, const DigiView& digis, const Joining& joining,
                                     Model&& model) {
  check(digis, detector);
  std::vector<std::size_t> order = by_place(digis), cuts;
  if (!joining.mask.is_empty()) {
    std::erase_if(order, [&](std::size_t row) { return joining.mask(gid_of_row(detector, digis, row)); });
  }
  if constexpr (requires(std::size_t row) { model.keeps(detector.layers.front(), row); }) {
    std::erase_if(order, [&](std::size_t row) {
      return !model.keeps(detector.layers[static_cast<std::size_t>(digis.layer[row])], row);
    });
  }
  Columns<ClusterRow> clusters;
  clusters.reserve(digis.size());
  std::vector<ClusterRow> sheet;
  std::vector<CrossingPair> pairs;
  const auto flush = [&] {
    if (sheet.empty()) return;
    const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(sheet.front().layer)];
    find_pairs(layer, sheet, model, pairs);
    if constexpr (requires { model.place(layer, sheet, pairs, std::size_t{}); }) {
      model.place(layer, sheet, pairs, clusters.size());
    }
    if constexpr (!requires { std::remove_cvref_t<Model>::knows_lost_charge; }) {
      for (ClusterRow& cluster : sheet) widen(layer, joining.mask, cluster);
    }
    write_sheet(layer, sheet, pairs, clusters);
    sheet.clear();
  };
  for (std::size_t begin = 0, end; begin < order.size(); begin = end) {
    end = begin + 1;
    while (end < order.size() && adjacent(detector, digis, order[end - 1], order[end], joining)) ++end;
    const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(digis.layer[order[begin]])];
    if (begin > 0 && digis.sheet_of(order[begin]) != digis.sheet_of(order[begin - 1])) flush();
    const std::span<const std::size_t> rows(&order[begin], end - begin);
    cuts.assign(1, 0);
    model.cuts(layer, rows, cuts);
    cuts.push_back(rows.size() - 1);
    for (std::size_t k = 1; k < cuts.size(); ++k) {
      const StripRun run{rows.subspan(cuts[k - 1], cuts[k] - cuts[k - 1] + 1), k > 1, k + 1 < cuts.size()};
      sheet.push_back(model.make(layer, run, clusters.size() + sheet.size()));
    }
  }
  flush();
  return clusters;
}

}  // namespace cgemit

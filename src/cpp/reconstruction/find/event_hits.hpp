// The hits of one event, in an order that does not depend on that of the input, with look-up by layer.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>
#include <tuple>
#include <vector>

#include "detector/wires.hpp"
#include "kalman/group.hpp"
#include "reconstruction/find/pair_scores.hpp"

namespace cgemit {

class EventHits {
 public:
  EventHits(const Detector& detector, const PairScores& pairs)
      : detector_(detector), pairs_(pairs), cells_(detector.wires.size()) {
    for (std::size_t i = 0; i < cells_.size(); ++i)
      cells_[i].assign(static_cast<std::size_t>(detector.wires[i].cells), -1);
    begin_.resize(2 * detector.layers.size() + 1);
    fired_.resize(cells_.size());
    begin_wires_.resize(cells_.size() + 1);
  }

  void load(std::span<const Hit> hits, std::int64_t first) {
    for (const Hit& hit : hits_)
      if (hit.view == View::wire) cell(hit) = -1;
    sort(hits);
    hits_.clear();
    sources_.clear();
    std::ranges::fill(fired_, 0);
    std::ranges::fill(begin_, 0);
    for (const auto& [where, i] : order_) {
      const Hit& hit = hits[static_cast<std::size_t>(i)];
      if (hit.view != View::wire) {
        ++begin_[place(static_cast<std::size_t>(hit.layer), hit.view) + 1];
      } else {
        // Of several hits of a cell, the earliest counts. A hit from beyond the cell came too late for a
        // track; one of a hot wire is of no track.
        const auto layer = static_cast<std::size_t>(hit.layer);
        if (cell(hit) >= 0 || hit.value > reach(hit) ||
            detector_.wires[layer].is_masked(static_cast<std::size_t>(hit.channel)))
          continue;
        cell(hit) = static_cast<std::int32_t>(hits_.size());
        ++fired_[layer];
        prefetch(detector_.wires[layer].placed[static_cast<std::size_t>(hit.channel)]);
      }
      hits_.push_back(hit);
      sources_.push_back(first + i);
    }
    for (std::size_t i = 1; i < begin_.size(); ++i) begin_[i] += begin_[i - 1];
    begin_wires_[0] = begin_.back();
    for (std::size_t i = 0; i < fired_.size(); ++i) begin_wires_[i + 1] = begin_wires_[i] + fired_[i];
    taken_.assign(hits_.size(), 0);
  }

  std::int32_t size() const { return static_cast<std::int32_t>(hits_.size()); }
  const Hit& operator[](std::int32_t id) const { return hits_[static_cast<std::size_t>(id)]; }
  std::int64_t source(std::int32_t id) const { return sources_[static_cast<std::size_t>(id)]; }

  // Clusters of one view of a layer have the numbers first(...) to last(...), the latter excluded.
  std::int32_t first(std::size_t layer, View view) const { return begin_[place(layer, view)]; }
  std::int32_t last(std::size_t layer, View view) const { return begin_[place(layer, view) + 1]; }
  // Hits on wires follow the clusters.
  std::int32_t first_wire() const { return begin_.back(); }
  // Those of a layer have the numbers first_wire(...) to last_wire(...), the latter excluded, in the order of
  // their cells.
  std::int32_t first_wire(std::size_t layer) const { return begin_wires_[layer]; }
  std::int32_t last_wire(std::size_t layer) const { return begin_wires_[layer + 1]; }
  // The hit of a cell, or -1.
  std::int32_t at(std::size_t layer, std::int64_t number) const {
    return cells_[layer][static_cast<std::size_t>(number)];
  }

  // How well an X and a V cluster fit each other, by charge and time.
  double pair_score(std::int32_t x, std::int32_t v) const { return pairs_.of(source(x), source(v)); }
  bool is_of_point(std::int32_t id) const { return pairs_.is_of_point(source(id)); }
  bool may_pair(std::int32_t x, std::int32_t v) const { return pair_score(x, v) > PairScores::impossible; }

  // Whether a track that is beyond doubt has the hit.
  bool is_taken(std::int32_t id) const { return taken_[static_cast<std::size_t>(id)] != 0; }
  void take(std::int32_t id) { taken_[static_cast<std::size_t>(id)] = 1; }

  // Expected number of foreign hits per mm of the measured coordinate, from the other hits of this event.
  double density(std::size_t layer, View view) const {
    if (view == View::wire) {
      const WireLayer& wires = detector_.wires[layer];
      return (fired_[layer] + 0.5) / (2 * pi * wires.r_end);
    }
    const MeasuringLayer& plane = detector_.layers[layer];
    const double width = view == View::x ? plane.strips_x * plane.pitch_x : plane.strips_v * plane.pitch_v;
    return std::max(last(layer, view) - first(layer, view) - 0.5, 0.5) / (plane.sheets * width);
  }
  // The cells of a layer that have a hit, and their share.
  std::int32_t fired(std::size_t layer) const { return fired_[layer]; }
  double occupancy(std::size_t layer) const { return occupancy(layer, fired_[layer]); }
  // The share of those that no track beyond doubt has.
  double free_occupancy(std::size_t layer) const {
    return occupancy(layer,
                     std::count(taken_.begin() + first_wire(layer), taken_.begin() + last_wire(layer), 0));
  }

 private:
  // A hit of the input by its place: kind, layer, view and channel in one number.
  struct Placed {
    std::uint64_t where;
    std::int32_t number;
  };

  void sort(std::span<const Hit> hits) {
    order_.clear();
    for (std::size_t i = 0; i < hits.size(); ++i) {
      const Hit& hit = hits[i];
      const std::uint64_t kind = hit.view == View::wire ? 1 : 0, view = hit.view == View::v ? 1 : 0;
      const auto layer = static_cast<std::uint64_t>(hit.layer),
                 channel = static_cast<std::uint64_t>(hit.channel);
      order_.push_back({(kind << 60) | (layer << 40) | (view << 36) | channel, static_cast<std::int32_t>(i)});
    }
    const auto key = [&](const Placed& placed) {
      const Hit& hit = hits[static_cast<std::size_t>(placed.number)];
      return std::tuple(hit.value, hit.sigma, hit.size, placed.number);
    };
    std::ranges::sort(order_, [&](const Placed& a, const Placed& b) {
      return a.where != b.where ? a.where < b.where : key(a) < key(b);
    });
  }

  double occupancy(std::size_t layer, std::int64_t cells) const {
    return (static_cast<double>(cells) + 0.5) / detector_.wires[layer].cells;
  }
  static std::size_t place(std::size_t layer, View view) { return 2 * layer + (view == View::v ? 1 : 0); }
  double reach(const Hit& hit) const {
    const WireLayer& layer = detector_.wires[static_cast<std::size_t>(hit.layer)];
    return 1.6 * pi * layer.r_end / layer.cells;
  }
  std::int32_t& cell(const Hit& hit) {
    return cells_[static_cast<std::size_t>(hit.layer)][static_cast<std::size_t>(hit.channel)];
  }

  const Detector& detector_;
  const PairScores& pairs_;
  std::vector<Hit> hits_;
  std::vector<std::int64_t> sources_;
  std::vector<Placed> order_;
  std::vector<std::int32_t> begin_, fired_, begin_wires_;
  std::vector<std::vector<std::int32_t>> cells_;
  std::vector<std::uint8_t> taken_;
};

}  // namespace cgemit

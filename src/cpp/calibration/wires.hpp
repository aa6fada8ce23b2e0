// Sums of the displacements of the ends of single wires: many columns, of which a track sees four for each of
// its wires. They go through the filter as those of other constants (sums.hpp), with columns of their own in
// each lane.
#pragma once

#include <array>
#include <cmath>
#include <span>
#include <vector>

#include "calibration/columns.hpp"
#include "calibration/sums.hpp"
#include "common/units.hpp"
#include "kalman/filter.hpp"

namespace cgemit {

template <class T>
class WirePush {
 public:
  WirePush(const ColumnMap& map, WireSums& out) : map_(map), out_(out) {}

  // Forgets the tracks before.
  void begin() {
    own_.clear();
    right_.clear();
    normal_.clear();
    bias_.clear();
  }

  // The next measurement, inward, of the lanes `who`.
  CGEMIT_FLATTEN void push(const Detector& detector, const Slot<T>& slot, const MeasuredAt<T>& site,
                           mask_of<T> who, const std::array<std::span<const Hit>, lanes_of<T>>& hits) {
    const std::size_t before = bias_.size();
    if (slot.view == View::wire) add_columns(detector, slot, site, who, hits);
    const T inverse = select(who, slot.inverse, T(0.0));
    const Five<T> gain = select<T>(who, inverse * slot.ch, Five<T>::zero());
    const T weighted = select(who, inverse * slot.innovation, T(0.0));
    for (std::size_t c = 0; c < bias_.size(); ++c) {
      const T e =
          c < before ? select(who, T(0.0) - dot(slot.row, bias_[c]), T(0.0)) : own_[c / 4].derivative[c % 4];
      innovation_[c] = e;
      bias_[c] = bias_[c] + e * gain;
      right_[c] += e * weighted;
    }
    T* entries = normal_.data();
    for (std::size_t i = 0; i < bias_.size(); ++i) {
      const T e = inverse * innovation_[i];
      for (std::size_t j = 0; j <= i; ++j) entries[j] += e * innovation_[j];
      entries += i + 1;
    }
  }

  // Adds the tracks of the lanes `good`.
  void add(mask_of<T> good) {
    for (int k = 0; k < lanes_of<T>; ++k)
      if (lane(good, k)) add_track(k);
  }

 private:
  // The columns of one slot: of another wire in each lane, null where the lane has none.
  struct Own {
    std::array<const std::array<int, 4>*, lanes_of<T>> columns;
    std::array<T, 4> derivative;
    T information;
  };

  void add_columns(const Detector& detector, const Slot<T>& slot, const MeasuredAt<T>& site, mask_of<T> who,
                   const std::array<std::span<const Hit>, lanes_of<T>>& hits) {
    Own own{{}, {T(0.0), T(0.0), T(0.0), T(0.0)}, select(who, 1.0 / slot.variance, T(0.0))};
    bool some = false;
    for (int k = 0; k < lanes_of<T>; ++k) {
      const auto i = static_cast<std::size_t>(k);
      if (!lane(who, k)) continue;
      const Hit& hit = hits[i][static_cast<std::size_t>(slot.hit[i])];
      const auto number = static_cast<std::size_t>(hit.layer);
      if (map_.single[number].empty()) continue;
      some = true;
      own.columns[i] = &map_.single[number][static_cast<std::size_t>(hit.channel)];
      const std::array<double, 3> gradient{lane(site.gradient[0], k), lane(site.gradient[1], k),
                                           lane(site.gradient[2], k)};
      const auto values =
          derivatives(detector.wires[number], hit.channel, lane(site.z_wire, k), gradient, map_.chamber_turn);
      for (std::size_t c = 0; c < 4; ++c) set_lane(own.derivative[c], k, values[c]);
    }
    if (!some) return;
    own_.push_back(own);
    const std::size_t columns = bias_.size() + 4;
    bias_.resize(columns, Five<T>::zero());
    right_.resize(columns, T(0.0));
    innovation_.resize(columns, T(0.0));
    normal_.resize(columns * (columns + 1) / 2, T(0.0));
  }

  // By the shifts of the end at +z outward and along phi, and of that at -z. They are in the axes of the
  // layer, before its ends turn.
  static std::array<double, 4> derivatives(const WireLayer& layer, int wire, double z,
                                           const std::array<double, 3>& gradient,
                                           const std::array<double, 9>& chamber) {
    const double nominal = layer.phi_east + wire * (2 * pi / layer.cells);
    const double share = (z - layer.ends.low) / (layer.ends.high - layer.ends.low);
    // Turns that carry a direction of the layer into the beam's axes carry the gradient back.
    const std::array<double, 3> there = own_axes(layer.placement.turn, own_axes(chamber, gradient));
    std::array<double, 4> found;
    for (std::size_t end = 0; end < 2; ++end) {
      const double azimuth =
                       end == 0 ? nominal + layer.east.rotation : nominal - layer.twist + layer.west.rotation,
                   part = end == 0 ? share : 1 - share, c = std::cos(azimuth), s = std::sin(azimuth);
      found[2 * end] = -part * (c * there[0] + s * there[1]);
      found[2 * end + 1] = -part * (c * there[1] - s * there[0]);
    }
    return found;
  }
  static std::array<double, 3> own_axes(const std::array<double, 9>& turn,
                                        const std::array<double, 3>& beam) {
    std::array<double, 3> own;
    for (std::size_t i = 0; i < 3; ++i)
      own[i] = turn[3 * i] * beam[0] + turn[3 * i + 1] * beam[1] + turn[3 * i + 2] * beam[2];
    return own;
  }

  void add_track(int k) {
    seen_.clear();
    for (std::size_t m = 0; m < own_.size(); ++m) {
      const std::array<int, 4>* columns = own_[m].columns[static_cast<std::size_t>(k)];
      if (columns == nullptr) continue;
      const double information = lane(own_[m].information, k);
      for (std::size_t c = 0; c < 4; ++c) {
        const int column = (*columns)[c];
        if (column < 0) continue;
        const double derivative = lane(own_[m].derivative[c], k);
        const auto at = static_cast<std::size_t>(column);
        out_.measured[at] += information * derivative * derivative;
        out_.right[at] += lane(right_[4 * m + c], k);
        ++out_.hits[at];
        seen_.push_back({at, 4 * m + c});
      }
    }
    for (std::size_t a = 0; a < seen_.size(); ++a) {
      const auto [column, i] = seen_[a];
      for (std::size_t b = 0; b <= a; ++b) {
        const auto [other, j] = seen_[b];
        const double entry = lane(normal_[i * (i + 1) / 2 + j], k);
        // A wire that a track meets twice.
        out_.normal.at(column, other) += column == other && a != b ? 2 * entry : entry;
      }
    }
  }

  struct Seen {
    std::size_t column, local;
  };

  const ColumnMap& map_;
  WireSums& out_;
  std::vector<Own> own_;  // of the present tracks, from outside
  std::vector<Five<T>> bias_;
  std::vector<T> innovation_, right_, normal_;  // of their columns; the lower triangle by rows
  std::vector<Seen> seen_;
};

}  // namespace cgemit

// Derivatives of the measurements by constants of the detector: displacements of its parts, the relation of
// drift time and distance, shifts of clusters, the field. A constant that is larger by da than the
// description says changes measured minus predicted by (derivative) da.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <span>
#include <vector>

#include "detector/detector.hpp"
#include "kalman/group.hpp"
#include "kalman/tracer.hpp"
#include "motion/wire.hpp"

namespace cgemit {

// Columns of a part's shifts along x, y, z and of its turns about them; -1: the constant is not asked for.
using RigidColumns = std::array<int, 6>;

// A constant that changes drift distances: its column, and the change of the distance for a constant of 1 at
// distances (of the track: those that are measured are larger on average where cells end) of 0, `drift_step`,
// 2 `drift_step` ...
struct DriftColumn {
  int column;
  std::vector<double> change;
};

// The column of every constant, -1: not asked for. Vectors have an entry for each layer of the detector.
struct ColumnMap {
  int columns = 0;
  std::vector<RigidColumns> layers;                               // that make clusters, as a whole
  std::vector<std::array<RigidColumns, most_sheets>> sheets;      // of them
  RigidColumns chamber{-1, -1, -1, -1, -1, -1};                   // as a whole
  std::array<double, 9> chamber_turn{1, 0, 0, 0, 1, 0, 0, 0, 1};  // as in Placement
  std::array<double, 3> chamber_shift{};                          // mm, of the point about which it turns
  std::vector<RigidColumns> wires, east, west;  // layers of wires; their ends at +z and at -z
  std::vector<int> lorentz, z_scale;            // mm of X; length along the beam, relative
  std::vector<std::vector<DriftColumn>> drift;  // of layers of wires
  double drift_step = 1;                        // mm
  int field = -1;                               // ln of the field
  // Of each wire of each layer: shifts of its end at +z outward and along phi, and of that at -z. Empty: no
  // layer or wire; otherwise no other constant has a column (wires.hpp).
  std::vector<std::vector<std::array<int, 4>>> single;
};

// Where a track crosses a measurement, and the gradient of the measurement by a shift of the track there.
template <class T>
struct MeasuredAt {
  std::array<T, 3> point, gradient;  // mm; in the beam's axes
  T z_wire;                          // mm, of the closest point of the wire
};

// The observer of a trace that notes where the measurements of a group are.
template <class T>
class ColumnObserver : public NoObserver {
 public:
  static constexpr bool provides_hits = false, stops_at_wires = true;

  ColumnObserver(const Detector& detector, const Group<T>& group, std::vector<MeasuredAt<T>>& sites)
      : detector_(&detector), group_(&group), sites_(&sites) {
    sites.resize(group.slots.size());
  }

  template <class Motion>
  void meets(const Slot<T>& slot, const Motion& motion) {
    MeasuredAt<T>& site = (*sites_)[static_cast<std::size_t>(&slot - group_->slots.data())];
    const HelixPointOf<T>& at = motion.point();
    site.point = {at.x, at.y, at.z};
    if (slot.view == View::wire) {
      const ApproachOf<T> approach = distance_to_wire(at, slot.wire);
      site.gradient = {approach.nx, approach.ny, approach.nz};
      site.z_wire = approach.z_wire;
      return;
    }
    const MeasuringLayer& layer = detector_->layers[static_cast<std::size_t>(slot.layer)];
    if (!layer.placement.moved) {
      site.gradient = gradient(layer, slot, at);
      return;
    }
    const HelixPointOf<T> seen = seen_by(layer.placement, at);
    site.gradient = back(layer.placement, gradient(layer, slot, seen));
    site.point = back(layer.placement, {seen.x, seen.y, seen.z});
    for (std::size_t k = 0; k < 3; ++k) site.point[k] += layer.placement.shift[k];
  }

 private:
  // Of X or V where a track crosses a layer, in the layer's own axes. A shift of the track moves its crossing
  // of the cylinder by shift - flight (normal . shift)/(normal . flight).
  static std::array<T, 3> gradient(const MeasuringLayer& layer, const Slot<T>& slot,
                                   const HelixPointOf<T>& at) {
    const T per_radius = 1.0 / at.radius(), nx = at.x * per_radius, ny = at.y * per_radius;
    const T scale = layer.r_readout * per_radius, per_outward = 1.0 / at.outward();
    const T aside = at.sideways() * per_outward, rise = at.tanl * at.radius() * per_outward;
    const std::array<T, 3> x{scale * (-ny - nx * aside), scale * (nx - ny * aside), T(0.0)};
    if (slot.view == View::x) return x;
    const T along = T(layer.cos_stereo) - slot.k;
    const double sine = layer.sin_stereo;
    return {along * x[0] + sine * nx * rise, along * x[1] + sine * ny * rise, T(-sine)};
  }

  // A direction in the axes of a part in those of the beam.
  static std::array<T, 3> back(const Placement& part, const std::array<T, 3>& own) {
    const std::array<double, 9>& m = part.turn;
    std::array<T, 3> found;
    for (std::size_t k = 0; k < 3; ++k) found[k] = m[k] * own[0] + m[k + 3] * own[1] + m[k + 6] * own[2];
    return found;
  }

  const Detector* detector_;
  const Group<T>* group_;
  std::vector<MeasuredAt<T>>* sites_;
};

// One row of the matrix of derivatives, of a measurement in each lane.
template <class T>
class ColumnRow {
 public:
  explicit ColumnRow(const ColumnMap& map)
      : map_(map),
        values_(static_cast<std::size_t>(map.columns), T(0.0)),
        has_(static_cast<std::size_t>(map.columns), 0) {}

  // Columns that are not zero in some lane.
  const std::vector<int>& columns() const { return columns_; }
  const T& operator[](int column) const { return values_[static_cast<std::size_t>(column)]; }

  // The derivatives of a measurement that the tracks in the lanes `who` have met. `hits` of each lane.
  void fill(const Detector& detector, const Slot<T>& slot, const MeasuredAt<T>& site, const T& kappa,
            mask_of<T> who, const std::array<std::span<const Hit>, lanes_of<T>>& hits) {
    for (const int column : columns_) {
      values_[static_cast<std::size_t>(column)] = 0.0;
      has_[static_cast<std::size_t>(column)] = 0;
    }
    columns_.clear();
    if (map_.field >= 0) add(map_.field, who, slot.row[2] * kappa);
    if (slot.view != View::wire) {
      clusters(detector, slot, site, who, hits);
    } else {
      wires(detector, slot, site, who, hits);
    }
  }

 private:
  void add(int column, mask_of<T> who, const T& value) {
    if (column < 0 || !any(who)) return;
    const auto i = static_cast<std::size_t>(column);
    if (!has_[i]) columns_.push_back(column);
    has_[i] = 1;
    values_[i] = select(who, values_[i] + value, values_[i]);
  }

  // Directions about which a part turns that is turned by `turn` (its Placement): about x, then y, then z.
  static std::array<std::array<double, 3>, 3> axes(const std::array<double, 9>& turn) {
    const double across = std::sqrt(turn[0] * turn[0] + turn[1] * turn[1]);
    return {{{turn[0], turn[1], turn[2]}, {-turn[1] / across, turn[0] / across, 0}, {0, 0, 1}}};
  }

  // Of a part that moves by t + w x p: p is `point` from the point about which it turns.
  void rigid(const RigidColumns& columns, mask_of<T> who, const std::array<T, 3>& gradient,
             const std::array<T, 3>& p, const T& share, const std::array<double, 9>& turn) {
    const std::array<T, 3> moment{p[1] * gradient[2] - p[2] * gradient[1],
                                  p[2] * gradient[0] - p[0] * gradient[2],
                                  p[0] * gradient[1] - p[1] * gradient[0]};
    const auto about = axes(turn);
    for (std::size_t i = 0; i < 3; ++i) {
      add(columns[i], who, -share * gradient[i]);
      add(columns[i + 3], who,
          -share * (about[i][0] * moment[0] + about[i][1] * moment[1] + about[i][2] * moment[2]));
    }
  }
  static constexpr std::array<double, 9> in_place{1, 0, 0, 0, 1, 0, 0, 0, 1};

  static std::array<T, 3> from(const std::array<double, 3>& shift, const std::array<T, 3>& point) {
    return {point[0] - shift[0], point[1] - shift[1], point[2] - shift[2]};
  }

  void clusters(const Detector& detector, const Slot<T>& slot, const MeasuredAt<T>& site, mask_of<T> who,
                const std::array<std::span<const Hit>, lanes_of<T>>& hits) {
    const auto number = static_cast<std::size_t>(slot.layer);
    const MeasuringLayer& layer = detector.layers[number];
    const std::array<T, 3> point = from(layer.placement.shift, site.point);
    rigid(map_.layers[number], who, site.gradient, point, T(1.0), layer.placement.turn);
    for (int k = 0; k < lanes_of<T>; ++k) {
      if (!lane(who, k)) continue;
      const Hit& hit =
          hits[static_cast<std::size_t>(k)][static_cast<std::size_t>(slot.hit[static_cast<std::size_t>(k)])];
      rigid(map_.sheets[number][static_cast<std::size_t>(hit.channel)], only(k), site.gradient, point, T(1.0),
            layer.placement.turn);
    }
    const bool is_x = slot.view == View::x;
    add(map_.lorentz[number], who, is_x ? T(1.0) : T(layer.cos_stereo) - slot.k);
    if (!is_x) add(map_.z_scale[number], who, layer.sin_stereo * point[2]);
  }

  // Wires of different layers may share a slot.
  void wires(const Detector& detector, const Slot<T>& slot, const MeasuredAt<T>& site, mask_of<T> who,
             const std::array<std::span<const Hit>, lanes_of<T>>& hits) {
    rigid(map_.chamber, who, site.gradient, from(map_.chamber_shift, site.point), T(1.0), map_.chamber_turn);
    const T slope_x = slot.wire.ex / slot.wire.ez, slope_y = slot.wire.ey / slot.wire.ez;
    for (int k = 0; k < lanes_of<T>; ++k) {
      if (!lane(who, k)) continue;
      const Hit& hit =
          hits[static_cast<std::size_t>(k)][static_cast<std::size_t>(slot.hit[static_cast<std::size_t>(k)])];
      const auto number = static_cast<std::size_t>(hit.layer);
      const mask_of<T> one = only(k);
      rigid(map_.wires[number], one, site.gradient, site.point, T(1.0), in_place);
      const Ends& ends = detector.wires[number].ends;
      const T share = (site.z_wire - ends.low) * (1 / (ends.high - ends.low));
      const auto end = [&](double z) {
        return std::array<T, 3>{slot.wire.x + slope_x * z, slot.wire.y + slope_y * z, T(z)};
      };
      rigid(map_.east[number], one, site.gradient, end(ends.high), share, in_place);
      rigid(map_.west[number], one, site.gradient, end(ends.low), 1.0 - share, in_place);
      const double drift = std::abs(hit.value), value = lane(slot.value, k);
      // A value between both sides of a wire tells nothing of its distance.
      if (std::abs(value) < certain * drift) continue;
      const double side = value < 0 ? -1 : 1, distance = std::abs(lane(slot.predicted, k));
      for (const DriftColumn& column : map_.drift[number])
        add(column.column, one, T(side * at(column.change, distance / map_.drift_step)));
    }
  }

  // Share of its distance that the value of a wire hit keeps where its side is known.
  static constexpr double certain = 0.99;

  static mask_of<T> only(int k) {
    mask_of<T> mask(false);
    set_lane(mask, k, true);
    return mask;
  }
  // Linear between the points, constant beyond.
  static double at(const std::vector<double>& values, double place) {
    const double last = static_cast<double>(values.size() - 1), x = std::min(place, last);
    const auto i = static_cast<std::size_t>(std::min(std::floor(x), std::max(last - 1, 0.0)));
    const double part = x - static_cast<double>(i);
    return values.size() == 1 ? values[0] : (1 - part) * values[i] + part * values[i + 1];
  }

  const ColumnMap& map_;
  std::vector<T> values_;
  std::vector<char> has_;
  std::vector<int> columns_;
};

}  // namespace cgemit

// The sums over many tracks, one per lane.
#pragma once

#include <algorithm>
#include <optional>
#include <vector>

#include "calibration/sums.hpp"
#include "calibration/wires.hpp"
#include "common/angles.hpp"
#include "kalman/builder.hpp"
#include "kalman/field_reference.hpp"
#include "kalman/filter.hpp"

namespace cgemit {

template <class T>
class SumsBatch {
 public:
  SumsBatch(const Detector& detector, const FittedTracks& tracks, const ColumnMap& map,
            const SumsOutput& output)
      : detector_(detector),
        tracks_(tracks),
        map_(map),
        out_(output),
        builder_(detector),
        row_(map),
        columns_(output.wires == nullptr ? static_cast<std::size_t>(map.columns) : 0),
        bias_(columns_),
        innovation_(columns_),
        reached_(columns_),
        normal_(columns_ * columns_, T(0.0)),
        right_(columns_, T(0.0)),
        measured_(columns_, T(0.0)) {
    if (output.wires != nullptr) wires_.emplace(map, *output.wires);
    unroll<parameters>([&](auto i) {
      const double sigma = tracks_.prior_sigma[static_cast<std::size_t>(i)];
      prior_[i] = sigma * sigma;
    });
  }

  void run() {
    for (std::size_t first = 0; first < tracks_.tracks() && !tracks_.interrupted();) {
      std::size_t n = 1;
      while (n < width && first + n < tracks_.tracks() && kind(first + n) == kind(first)) ++n;
      add(first, n);
      first += n;
    }
    for (std::size_t i = 0; i < columns_; ++i) {
      out_.right[i] += sum(right_[i]);
      out_.measured[i] += sum(measured_[i]);
      for (std::size_t j = 0; j < columns_; ++j) {
        const double entry = sum(normal_[i * columns_ + j]);
        out_.normal[i * columns_ + j] += entry;
        if (i != j) out_.normal[j * columns_ + i] += entry;
      }
    }
  }

 private:
  static constexpr std::size_t width = lanes_of<T>;

  static double sum(const T& numbers) {
    double total = 0;
    for (int k = 0; k < lanes_of<T>; ++k) total += lane(numbers, k);
    return total;
  }

  Projectile kind(std::size_t track) const {
    return projectile_of(tracks_.mass[track], tracks_.reference[track].kappa);
  }
  T column(std::span<const double> values, std::size_t first, std::size_t n) const {
    return gathered<T>(
        [&](int i) { return values[std::min(first + static_cast<std::size_t>(i), first + n - 1)]; });
  }

  void add(std::size_t first, std::size_t n) {
    for (std::size_t k = 0; k < width; ++k) {
      const std::size_t track = first + std::min(k, n - 1);  // idle lanes hold a valid helix
      const int i = static_cast<int>(k);
      const Perigee& from = tracks_.reference[track];
      set_lane(helix_.d, i, from.d);
      set_lane(helix_.psi, i, from.psi);
      set_lane(helix_.kappa, i, from.kappa);
      set_lane(helix_.z0, i, from.z0);
      set_lane(helix_.tanl, i, from.tanl);
      hits_[k] =
          k < n ? tracks_.hits.subspan(tracks_.first(track), tracks_.count(track)) : std::span<const Hit>();
    }
    // The side of a wire is that of its value.
    most_ = 0;
    for (const auto& hits : hits_) most_ = std::max(most_, hits.size());
    no_sides_.assign(most_, 0);
    for (std::size_t k = 0; k < width; ++k) sides_[k] = std::span(no_sides_).first(hits_[k].size());
    builder_.build(std::span(hits_).first(n), std::span(sides_).first(n), group_);
    set_kinks(first, n);
    trace(first, n);
    if (!tracks_.scattering) forget_noise();
    const mask_of<T> good = filter_tracks(first, n);
    if (columns_ > 0) push(good, first);
    if (wires_) push_wires(good);
    if (out_.bias != nullptr) write_bias(first, n);
  }

  void set_kinks(std::size_t first, std::size_t n) {
    const std::size_t slabs = detector_.slabs.size();
    group_.kinked = mask_of<T>(false);
    for (std::size_t k = 0; k < n; ++k) {
      const auto kinks = tracks_.kinks.subspan(2 * slabs * (first + k), 2 * slabs);
      if (std::ranges::any_of(kinks, [](double angle) { return angle != 0; }))
        set_lane(group_.kinked, static_cast<int>(k), true);
    }
    if (!any(group_.kinked)) return;
    for (const GroupStep& step : group_.steps) {
      if (!step.is_slab) continue;
      Kink<T>& kink = group_.kinks[static_cast<std::size_t>(step.noise)];
      kink = {T(0.0), T(0.0), T(0.0), T(1.0), T(0.0)};
      for (std::size_t k = 0; k < n; ++k) {
        const double* angles =
            &tracks_.kinks[2 * (slabs * (first + k) + static_cast<std::size_t>(step.slab))];
        set_lane(kink.aside, static_cast<int>(k), angles[0]);
        set_lane(kink.up, static_cast<int>(k), angles[1]);
      }
    }
  }

  void trace(std::size_t first, std::size_t n) {
    const SpeciesOf<T> species{column(tracks_.mass, first, n), column(tracks_.charge, first, n), kind(first)};
    const T given = column(tracks_.matter_p, first, n);
    const MatterMomentum<T> matter{given > 0.0, select(given > 0.0, given, T(1.0))};
    const ColumnObserver<T> observer(detector_, group_, sites_);
    const mask_of<T> all(true);
    if (detector_.field.is_uniform()) {
      Tracer<T, HelixMotion<T>, ColumnObserver<T>>(detector_, helix_, species, group_, observer, matter)
          .run(all);
    } else {
      Tracer<T, FieldReference<T>, ColumnObserver<T>>(detector_, helix_, species, group_, observer, matter)
          .run(all);
    }
  }

  void forget_noise() {
    for (SlabNoise<T>& noise : group_.noise) noise = {};
    for (DenseNoise<T>& noise : group_.dense_noise) noise = {};
  }

  // Filters the tracks and writes their rows. Returns the lanes with a covariance.
  mask_of<T> filter_tracks(std::size_t first, std::size_t n) {
    T count(0.0);
    for (Slot<T>& slot : group_.slots) {
      slot.used = mask_of<T>(false);
      slot.value = 0.0;
      slot.variance = 1.0;
      for (std::size_t k = 0; k < n; ++k) {
        if (slot.hit[k] < 0) continue;
        const UsedHit& hit = tracks_.used[tracks_.first(first + k) + static_cast<std::size_t>(slot.hit[k])];
        const int i = static_cast<int>(k);
        if (hit.used == 0 || !lane(slot.met, i)) continue;
        set_lane(slot.used, i, true);
        set_lane(slot.value, i, hit.value);
        set_lane(slot.variance, i, hit.variance);
      }
      slot.residual = select(slot.used, slot.value - slot.predicted, T(0.0));
      count += select(slot.used, T(1.0), T(0.0));
    }
    const FilteredState<T> state = filter(detector_, group_, Symmetric<T>::diagonal(prior_));
    mask_of<T> good = sound(state) & positive_definite(state.c) & (count > T(parameters));
    for (int k = static_cast<int>(n); k < lanes_of<T>; ++k) set_lane(good, k, false);
    for (std::size_t k = 0; k < n; ++k)
      write_row(out_.rows[first + k], state, lane(good, static_cast<int>(k)),
                lane(count, static_cast<int>(k)), static_cast<int>(k));
    return good;
  }

  void write_row(SummedTrack& row, const FilteredState<T>& state, bool good, double hits, int k) const {
    row.used = good ? 1 : 0;
    row.hits = static_cast<std::int32_t>(hits);
    row.chi2 = lane(state.chi2, k);
    row.helix = {lane(helix_.d + state.x[0], k), wrap_angle(lane(helix_.psi + state.x[1], k) - 0.5 * pi),
                 lane(helix_.kappa + state.x[2], k), lane(helix_.z0 + state.x[3], k),
                 lane(helix_.tanl + state.x[4], k)};
    for (int i = 0; i < parameters; ++i)
      for (int j = 0; j < parameters; ++j)
        row.covariance[static_cast<std::size_t>(i)][static_cast<std::size_t>(j)] = lane(state.c(i, j), k);
  }

  // From the outermost measurement inward, as the filter. A column is zero up to its first measurement.
  void push(mask_of<T> good, std::size_t first) {
    std::ranges::fill(reached_, 0);
    active_.clear();
    for (std::size_t i = group_.steps.size(); i-- > 0;) {
      const GroupStep& step = group_.steps[i];
      for (std::int32_t s = step.last; s-- > step.first;) {
        const Slot<T>& slot = group_.slots[static_cast<std::size_t>(s)];
        push(slot, good);
        if (out_.innovations != nullptr) note(slot, slot.used & good, first);
      }
    }
  }

  void push_wires(mask_of<T> good) {
    wires_->begin();
    for (std::size_t i = group_.steps.size(); i-- > 0;) {
      const GroupStep& step = group_.steps[i];
      for (std::int32_t s = step.last; s-- > step.first;) {
        const auto number = static_cast<std::size_t>(s);
        const Slot<T>& slot = group_.slots[number];
        if (const mask_of<T> who = slot.used & good; any(who))
          wires_->push(detector_, slot, sites_[number], who, hits_);
      }
    }
    wires_->add(good);
  }

  CGEMIT_FLATTEN void push(const Slot<T>& slot, mask_of<T> good) {
    const mask_of<T> who = slot.used & good;
    if (!any(who)) return;
    row_.fill(detector_, slot, sites_[static_cast<std::size_t>(&slot - group_.slots.data())], helix_.kappa,
              who, hits_);
    const T information = select(who, 1.0 / slot.variance, T(0.0));
    for (const int column : row_.columns()) {
      const auto c = static_cast<std::size_t>(column);
      measured_[c] += information * row_[column] * row_[column];
      if (reached_[c]) continue;
      reached_[c] = 1;
      active_.push_back(c);
      bias_[c] = Five<T>::zero();
    }
    const T inverse = select(who, slot.inverse, T(0.0));
    const Five<T> gain = select<T>(who, inverse * slot.ch, Five<T>::zero());
    const T weighted = select(who, inverse * slot.innovation, T(0.0));
    for (const std::size_t c : active_) {
      const T e = select(who, row_[static_cast<int>(c)] - dot(slot.row, bias_[c]), T(0.0));
      bias_[c] = bias_[c] + e * gain;
      innovation_[c] = e;
      right_[c] += e * weighted;
    }
    for (std::size_t i = 0; i < active_.size(); ++i) {
      const T e = inverse * innovation_[active_[i]];
      T* const entries = &normal_[active_[i] * columns_];
      for (std::size_t j = i; j < active_.size(); ++j) entries[active_[j]] += e * innovation_[active_[j]];
    }
  }

  void note(const Slot<T>& slot, mask_of<T> who, std::size_t first) const {
    InnovationRows& rows = *out_.innovations;
    for (int k = 0; k < lanes_of<T>; ++k) {
      if (!lane(who, k)) continue;
      const std::size_t before = rows.column.size();
      for (const std::size_t c : active_) {
        const double e = lane(innovation_[c], k);
        if (e == 0) continue;
        rows.column.push_back(static_cast<std::int32_t>(c));
        rows.derivative.push_back(e);
      }
      if (rows.column.size() == before) continue;
      rows.ends.push_back(static_cast<std::int64_t>(rows.column.size()));
      rows.track.push_back(out_.first_track + static_cast<std::int64_t>(first) + k);
      rows.residual.push_back(lane(slot.innovation, k));
      rows.variance.push_back(1 / lane(slot.inverse, k));
    }
  }

  void write_bias(std::size_t first, std::size_t n) const {
    for (std::size_t k = 0; k < n; ++k) {
      double* to = out_.bias + (first + k) * columns_ * parameters;
      std::fill_n(to, columns_ * parameters, 0.0);
      for (const std::size_t c : active_)
        for (int i = 0; i < parameters; ++i)
          to[c * parameters + static_cast<std::size_t>(i)] = lane(bias_[c][i], static_cast<int>(k));
    }
  }

  const Detector& detector_;
  const FittedTracks& tracks_;
  const ColumnMap& map_;
  const SumsOutput& out_;
  GroupBuilder<T> builder_;
  Group<T> group_;
  std::vector<MeasuredAt<T>> sites_;
  ColumnRow<T> row_;
  std::size_t columns_;  // of constants that are no single wires
  std::optional<WirePush<T>> wires_;
  std::vector<Five<T>> bias_;  // of the present lanes, of the columns in `active_`
  std::vector<T> innovation_;
  std::vector<char> reached_;
  std::vector<std::size_t> active_;
  std::vector<T> normal_, right_, measured_;
  Five<T> prior_;
  PerigeeOf<T> helix_;
  std::array<std::span<const Hit>, width> hits_;
  std::array<std::span<const std::int8_t>, width> sides_;
  std::vector<std::int8_t> no_sides_;
  std::size_t most_ = 0;
};

}  // namespace cgemit

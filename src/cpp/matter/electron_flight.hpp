// Transport of electrons around a drift gap: a single one, or one in each lane until none is left.
#pragma once

#include <cmath>

#include "common/compiler.hpp"
#include "common/lanes/philox.hpp"
#include "matter/electron_steps.hpp"
#include "matter/electrons.hpp"

namespace cgemit {

template <class T>
class ElectronFlight {
 public:
  using Mask = mask_of<T>;
  static constexpr int width = lanes_of<T>;

  explicit ElectronFlight(ElectronBatch& batch) : batch_(batch) {}

  void run() {
    if (batch_.electrons.empty()) return;
    for (int i = 0; i < width; ++i) {
      place_[index(i)].layer = batch_.electrons.front().matter->layers.data();
      start_next(i);
    }
    while (any(flying_)) {
      const Mask goes_on = step();
      each_lane(flying_ & !goes_on, [&](int i) {
        finish(i);
        start_next(i);
      });
    }
  }

 private:
  static std::size_t index(int i) { return static_cast<std::size_t>(i); }
  ElectronTask& task(int i) { return batch_.electrons[place_[index(i)].task]; }

  void start_next(int i) {
    const bool any_left = next_ < batch_.electrons.size();
    set_lane(flying_, i, any_left);
    if (!any_left) return;
    Place& at = place_[index(i)];
    at = {next_++, 0, nullptr};
    const ElectronTask& own = task(i);
    const Electron& e = own.electron;
    set_lane(e_.u, i, e.u);
    set_lane(e_.w, i, e.w);
    set_lane(e_.z, i, e.z);
    set_lane(e_.du, i, e.du);
    set_lane(e_.dw, i, e.dw);
    set_lane(e_.dz, i, e.dz);
    set_lane(e_.energy, i, e.energy);
    set_lane(way_, i, 0);
    set_lane(steps_, i, 0);
    set_lane(field_, i, own.bz / radius_per_kappa);
    set_lane(z_min_, i, own.matter->z_min);
    set_lane(z_max_, i, own.matter->z_max);
    draws_.set(i, own.stream, Purpose::deltas, own.place);
    const auto& layers = own.matter->layers;
    std::size_t layer = 0;
    while (layer + 1 < layers.size() &&
           (e.w > layers[layer].w_out || (e.w == layers[layer].w_out && e.dw > 0)))
      ++layer;
    enter(i, layer);
    begin_piece(i);
  }

  void finish(int i) {
    end_piece(i);
    task(i).electron = {lane(e_.u, i),  lane(e_.w, i),  lane(e_.z, i),     lane(e_.du, i),
                        lane(e_.dw, i), lane(e_.dz, i), lane(e_.energy, i)};
    task(i).way = lane(way_, i);
  }

  void enter(int i, std::size_t number) {
    const GapMatter& matter = *task(i).matter;
    const ElectronLayer& layer = matter.layers[number];
    place_[index(i)].number = number;
    place_[index(i)].layer = &layer;
    set_lane(w_in_, i, layer.w_in);
    set_lane(w_out_, i, layer.w_out);
    set_lane(in_gap_, i, number == matter.gap);
    set_lane(inside_, i, number < matter.gap);
    set_lane(depth_, i, layer.depth);
    set_lane(density_, i, layer.density);
  }

  electron_step::Local<T> local() const {
    std::array<const ElectronPoint*, static_cast<std::size_t>(width)> at;
    for (int i = 0; i < width; ++i) {
      at[index(i)] = &place_[index(i)].layer->at[electron_step::bin_of(lane(e_.energy, i))];
    }
    const T part = electron_step::part_of(e_.energy);
    const auto ends = [&](double ElectronPoint::* value) {
      const T low = gathered<T>([&](int i) { return at[index(i)][0].*value; });
      return std::array<T, 2>{low, gathered<T>([&](int i) { return at[index(i)][1].*value; }) - low};
    };
    const auto between = [&](double ElectronPoint::* value) {
      const auto [low, rise] = ends(value);
      return low + part * rise;
    };
    const auto [stopping, rise] = ends(&ElectronPoint::stopping);
    const T width_of_bin = electron_step::power_of_two(e_.energy) / electron_steps;
    return {stopping + part * rise,
            between(&ElectronPoint::path),
            between(&ElectronPoint::cut),
            between(&ElectronPoint::screening),
            between(&ElectronPoint::soft),
            between(&ElectronPoint::per_momentum),
            rise / width_of_bin};
  }

  // Moves all electrons by one step. Returns those that have not ended.
  CGEMIT_FLATTEN Mask step() {
    using namespace electron_step;
    const BlockOf<T> words = draws_.next();
    const Local<T> here = local();
    const T bend = field_ * here.per_momentum;  // rad/mm, charge -1
    const T free_path = -here.path * log(open_unit(words[0]));
    T length = smaller(free_path, smaller(longest_allowed(here), largest_turn / abs(bend)));
    ElectronOf<T> middle = e_;
    turn(middle, 0.5 * bend * length);
    const T border = to_border(middle);
    const Mask leaves = flying_ & (border <= length);
    length = select(leaves, border, length);
    move(middle, length);
    turn(e_, bend * length);
    steps_ += T(1.0);
    const Mask goes_on = flying_ & slow_down(here, length) & (e_.z >= z_min_) & (e_.z <= z_max_);
    if (const Mask soft = goes_on & (here.soft > 0.0); any(soft))
      scatter(soft, soft_scatter(here, length, open_unit(words[3])), words[2], 16);
    if (const Mask hard = goes_on & !leaves & (length == free_path); any(hard))
      scatter(hard, hard_scatter(here, open_unit(words[1])), words[2], 0);
    Mask stays = goes_on & !leaves;
    if (any(stays & !in_gap_)) stays = stays & (in_gap_ | can_return());
    each_lane(goes_on & leaves,
              [&](int i) { set_lane(stays, i, cross_border(i, lane(middle.dw, i) > 0, lane(bend, i))); });
    return stays & (steps_ < most_steps);
  }

  // The loss in a step is computed to second order, so a step may take up to a quarter of the energy.
  T longest_allowed(const electron_step::Local<T>& here) const {
    const T loss = 0.25 * e_.energy / here.stopping;
    return select(in_gap_, smaller(loss, electron_step::longest_step), loss);
  }

  T to_border(const ElectronOf<T>& e) const {
    const T way = (select(e.dw > 0.0, w_out_, w_in_) - e.w) / e.dw;
    return select(e.dw == 0.0, T(HUGE_VAL), larger(way, 0.0));
  }

  template <class FourWords>
  void scatter(const Mask& those, const T& mu, const FourWords& azimuth, int shift) {
    std::array<const electron_step::Around*, static_cast<std::size_t>(width)> at;
    const auto& circle = electron_step::circle();
    for (int i = 0; i < width; ++i) at[index(i)] = &circle[(word(azimuth, i) >> shift & 0xFFFF) >> 6];
    ElectronOf<T> after = e_;
    deflect(after, mu, gathered<T>([&](int i) { return at[index(i)]->cosine; }),
            gathered<T>([&](int i) { return at[index(i)]->sine; }));
    e_.du = select(those, after.du, e_.du);
    e_.dw = select(those, after.dw, e_.dw);
    e_.dz = select(those, after.dz, e_.dz);
  }

  void move(const ElectronOf<T>& direction, const T& length) {
    e_.u += length * direction.du;
    e_.w += length * direction.dw;
    e_.z += length * direction.dz;
    way_ += length;
  }

  // Returns the electrons that have energy left.
  Mask slow_down(const electron_step::Local<T>& here, const T& length) {
    using electron_step::shortest_piece;
    T loss = here.stopping * length * (1.0 - 0.5 * here.slope * length);
    const Mask ends = e_.energy - loss < least_electron;
    loss = select(ends, e_.energy, loss);
    e_.energy -= loss;
    left_ += select(in_gap_, loss, T(0.0));
    const T du = e_.u - from_u_, dw = e_.w - from_w_, dz = e_.z - from_z_;
    each_lane(flying_ & in_gap_ & (du * du + dw * dw + dz * dz > shortest_piece * shortest_piece),
              [this](int i) { end_piece(i); });
    return !ends;
  }

  // False if the electron does not come back.
  bool cross_border(int i, bool outward, double bend) {
    end_piece(i);
    const GapMatter& matter = *task(i).matter;
    const std::size_t from = place_[index(i)].number;
    const bool last = outward ? from + 1 == matter.layers.size() : from == 0;
    enter(i, last ? from : outward ? from + 1 : from - 1);
    set_lane(e_.w, i, outward != last ? lane(w_in_, i) : lane(w_out_, i));
    if (last && !curl_back(i, outward, bend)) return false;
    begin_piece(i);
    return lane(in_gap_, i) || lane(can_return(), i);
  }

  // Path outside the layers, where only the field acts: the electron turns until it meets the layers again.
  bool curl_back(int i, bool outward, double bend) {
    const double du = lane(e_.du, i), dw = lane(e_.dw, i);
    if ((dw > 0) != outward) return true;  // the field has turned it back at the border
    const double along = 2 * dw / bend;
    if (std::abs(along) > electron_step::farthest) return false;
    const double angle = std::atan2(du, std::abs(dw));
    const double turned = (bend > 0) == outward ? pi - 2 * angle : pi + 2 * angle;
    const double length = turned / std::abs(bend);
    set_lane(e_.u, i, lane(e_.u, i) + along);
    set_lane(e_.z, i, lane(e_.z, i) + length * lane(e_.dz, i));
    set_lane(e_.dw, i, -dw);
    set_lane(way_, i, lane(way_, i) + length);
    return true;
  }

  Mask can_return() const {
    const T way = select(inside_, w_out_ - e_.w, e_.w - w_in_);
    return practical_range(e_.energy) > depth_ + density_ * way;
  }

  void begin_piece(int i) {
    set_lane(from_u_, i, lane(e_.u, i));
    set_lane(from_w_, i, lane(e_.w, i));
    set_lane(from_z_, i, lane(e_.z, i));
    set_lane(left_, i, 0);
  }

  void end_piece(int i) {
    if (lane(in_gap_, i) && lane(left_, i) > 0) {
      batch_.append(task(i), {{lane(from_u_, i), lane(from_w_, i), lane(from_z_, i)},
                              {lane(e_.u, i), lane(e_.w, i), lane(e_.z, i)},
                              lane(left_, i),
                              0});
    }
    begin_piece(i);
  }

  // The electron that a lane follows, and its layer.
  struct Place {
    std::size_t task, number;
    const ElectronLayer* layer;
  };

  ElectronBatch& batch_;
  std::size_t next_ = 0;
  std::array<Place, static_cast<std::size_t>(width)> place_{};
  Mask flying_{false}, in_gap_{false}, inside_{false};
  BlockSeries<T> draws_;
  ElectronOf<T> e_{};
  T field_{0.0}, way_{0.0}, steps_{0.0};                   // field: rad/mm at 1 GeV/c
  T z_min_{0.0}, z_max_{0.0};                              // of the layer
  T w_in_{0.0}, w_out_{0.0}, depth_{0.0}, density_{0.0};   // of the layer
  T from_u_{0.0}, from_w_{0.0}, from_z_{0.0}, left_{0.0};  // the piece so far
};

}  // namespace cgemit

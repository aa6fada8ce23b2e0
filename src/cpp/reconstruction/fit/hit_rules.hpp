// Requirements on hits, checked before the fit.
#pragma once

#include <cmath>
#include <cstdint>
#include <span>
#include <string>
#include <tuple>
#include <vector>

#include "common/columns.hpp"
#include "common/problems.hpp"
#include "kalman/group.hpp"

namespace cgemit {

// Hits by column; each entry is a scalar measurement.
struct HitView {
  std::span<const std::uint8_t> kind;           // View
  std::span<const std::int32_t> layer;          // CGEM layer, or number of the wire layer
  std::span<const std::int32_t> channel, size;  // as in Hit
  std::span<const double> value, sigma, k, x;   // as in Hit; k and x may be empty
  std::span<const std::int8_t> side;            // of the wire; 0: unknown
  std::span<const std::int64_t> hit;            // row of its table, for messages; may be empty

  static constexpr auto columns() {
    return std::tuple(Column("kind", &HitView::kind), Column("layer", &HitView::layer),
                      Column("channel", &HitView::channel), Column("size", &HitView::size),
                      Column("value", &HitView::value), Column("sigma", &HitView::sigma));
  }

  static constexpr auto optional() {
    return std::tuple(Column("k", &HitView::k), Column("x", &HitView::x), Column("side", &HitView::side),
                      Column("hit", &HitView::hit));
  }
};

// What is wrong with a hit: the column, its value and what was expected of it.
struct HitProblem {
  std::size_t hit;
  std::string name, got, expected;
};

class HitRules {
 public:
  explicit HitRules(const Detector& detector);

  // Index into the detector's layers or wires; -1 if there is no such layer.
  int index(std::uint8_t kind, std::int32_t layer) const { return layer_of(kind, layer).index; }
  // Position of the layer among the surfaces, counted outward.
  int surface(std::uint8_t kind, std::int32_t layer) const { return layer_of(kind, layer).surface; }

  bool fits(const HitView& hits, std::size_t i) const {
    const Layer& layer = layer_of(hits.kind[i], hits.layer[i]);
    const double value = hits.value[i], sigma = hits.sigma[i];
    const int side = hits.side[i];
    const bool exists = hits.channel[i] >= 0 && hits.channel[i] < layer.channels;
    const bool numbers = std::abs(value) < HUGE_VAL && sigma > 0 && sigma < HUGE_VAL && hits.size[i] >= 0;
    return exists && numbers && side * side <= 1 && !(side != 0 && value < -most_below * sigma);
  }
  // Appends the problems of a hit.
  void explain(const HitView& hits, std::size_t i, std::vector<HitProblem>& problems) const;

 private:
  // Standard deviations that a drift distance may lie below 0. Of 10^15 Gaussian values none is farther.
  static constexpr double most_below = 8;

  struct Layer {
    int index = -1, channels = 0, surface = -1;
  };

  const Layer& layer_of(std::uint8_t kind, std::int32_t layer) const {
    const auto& layers = kind == static_cast<std::uint8_t>(View::wire) ? wires_ : cgem_;
    const auto number = static_cast<std::size_t>(layer);
    return kind <= static_cast<std::uint8_t>(View::wire) && layer >= 0 && number < layers.size()
               ? layers[number]
               : none_;
  }

  std::vector<Layer> cgem_, wires_;  // wires: by the experiment's layer number
  Layer none_;
};

// Copies hits first to first + n to `out`.
void copy_hits(const HitRules& rules, const HitView& hits, std::size_t first, std::size_t n,
               std::vector<Hit>& out);

// Copies the hits of tracks, which begin at `offsets`. False if one of them breaks a rule, or lies inside the
// one before.
bool copy_tracks(const HitRules& rules, const HitView& hits, std::span<const std::int64_t> offsets,
                 std::vector<Hit>& out);

// The first few dozen problems, and their number.
struct HitProblems {
  std::vector<HitProblem> listed;
  std::size_t count = 0;
};

HitProblems problems_of(const HitRules& rules, const HitView& hits);

void add_problems(const HitRules& rules, const HitView& hits, Problems& problems);

// Throws, listing them.
void check_hits(const HitRules& rules, const HitView& hits);

}  // namespace cgemit

// The columns of the digis table that clustering reads, and their order.
#pragma once

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <span>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "common/columns.hpp"
#include "detector/detector.hpp"

namespace cgemit {

struct DigiView {
  std::span<const std::int64_t> event;
  std::span<const std::int32_t> layer, sheet;
  std::span<const std::int8_t> view;
  std::span<const std::int32_t> strip;   // -1: no strip, the digi has a position
  std::span<const double> position;      // mm, X or V
  std::span<const double> charge, time;  // fC, ns
  std::span<const std::int64_t> truth;
  std::span<const std::int32_t> n_truths;

  std::size_t size() const { return event.size(); }
  auto sheet_of(std::size_t i) const { return std::tuple(event[i], layer[i], sheet[i]); }

  static constexpr auto columns() {
    return std::tuple(Column("event", &DigiView::event), Column("layer", &DigiView::layer),
                      Column("sheet", &DigiView::sheet), Column("view", &DigiView::view),
                      Column("strip", &DigiView::strip), Column("charge", &DigiView::charge),
                      Column("time", &DigiView::time), Column("truth", &DigiView::truth),
                      Column("n_truths", &DigiView::n_truths));
  }

  static constexpr auto optional() { return std::tuple(Column("position", &DigiView::position)); }
};

[[noreturn]] inline void refuse(std::size_t row, const char* what, std::int32_t value, std::int32_t count) {
  throw std::invalid_argument("digis row " + std::to_string(row) + ": " + what + " " + std::to_string(value) +
                              ", expected 0 to " + std::to_string(count - 1));
}

// Throws std::invalid_argument, naming the first row of `digis` with a number that is out of range.
inline void expect(std::size_t row, const char* what, std::int32_t value, std::int32_t count) {
  if (value < 0 || value >= count) refuse(row, what, value, count);
}

// Checks the layer, sheet and view of a digi, and returns its layer.
inline const MeasuringLayer& checked_layer(const Detector& detector, const DigiView& digis, std::size_t row) {
  expect(row, "layer", digis.layer[row], static_cast<std::int32_t>(detector.layers.size()));
  const MeasuringLayer& layer = detector.layers[static_cast<std::size_t>(digis.layer[row])];
  expect(row, "sheet", digis.sheet[row], layer.sheets);
  expect(row, "view", digis.view[row], 2);
  return layer;
}

// Rows by event, layer, sheet, view and strip; those without strips keep their order.
inline std::vector<std::size_t> by_place(const DigiView& digis) {
  std::vector<std::size_t> order(digis.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  const auto place = [&](std::size_t i) {
    return std::tuple_cat(digis.sheet_of(i), std::tuple(digis.view[i], digis.strip[i]));
  };
  const auto before = [&](std::size_t a, std::size_t b) { return place(a) < place(b); };
  if (!std::is_sorted(order.begin(), order.end(), before)) {
    std::stable_sort(order.begin(), order.end(), before);
  }
  return order;
}

}  // namespace cgemit

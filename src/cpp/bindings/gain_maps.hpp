// Gain maps of `cgemit.detector.core.gain_table`; an empty dict stands for a gain of 1 everywhere.
#pragma once

#include "bindings/fields.hpp"
#include "readout/strip_maps.hpp"

namespace cgemit::bindings {

inline GainMaps gain_maps(const Detector& detector, const py::dict& table) {
  if (table.empty()) return {};
  const auto shape = take<std::int32_t>(table, "shape");
  const auto values = take<double>(table, "values");
  return {detector, column(shape, "shape", static_cast<py::ssize_t>(2 * detector.layers.size())),
          column(values, "values", values.size())};
}

}  // namespace cgemit::bindings

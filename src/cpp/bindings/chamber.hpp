// The wire layers of a drift chamber.
#pragma once

#include <pybind11/pybind11.h>

#include <cstddef>
#include <vector>

#include "bindings/part.hpp"
#include "detector/detector.hpp"

namespace cgemit::bindings {

// The wire layers of a drift chamber, in place.
struct Chamber {
  std::vector<WireLayer> layers;
};

std::vector<Placement> placements_of(const pybind11::dict& columns, std::size_t n, const char* name);
std::vector<WireLayer> make_wires(const pybind11::dict& columns);
void check(Problems& problems, const std::vector<WireLayer>& wires);
// Wire layers that are checked with the rest of a detector; those of `make_chamber` were.
Chamber in_place(std::vector<WireLayer>&& layers, const pybind11::dict& columns);
Chamber make_chamber(const pybind11::dict& columns);

}  // namespace cgemit::bindings

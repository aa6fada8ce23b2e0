// The wire layers of a drift chamber.
#pragma once

#include <pybind11/pybind11.h>

#include <vector>

#include "bindings/part.hpp"
#include "detector/detector.hpp"

namespace cgemit::bindings {

// The wire layers of a drift chamber, in place.
struct Chamber {
  std::vector<WireLayer> layers;
};

// Wire layers as they are described, and how the chamber as a whole has moved.
struct WireTable {
  std::vector<WireLayer> layers;
  Placement chamber;
};

void set_moved(Placement& placement);
// Nothing but the columns that are right where there are problems.
WireTable read_wires(const pybind11::dict& columns, Problems& problems);
void check(Problems& problems, const WireTable& table);
// Of wire layers that are checked.
Chamber in_place(WireTable&& table);
Chamber make_chamber(const pybind11::dict& columns);

}  // namespace cgemit::bindings

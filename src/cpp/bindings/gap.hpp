// Converts the columns of the drift gaps to the core's structs.
#pragma once

#include <vector>

#include "bindings/arrays.hpp"
#include "detector/detector.hpp"

namespace cgemit::bindings {

std::vector<GapMatter> read_gaps(const py::list& gaps, Problems& problems);

}  // namespace cgemit::bindings

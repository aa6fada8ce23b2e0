// Columns of hits as the core wants them.
#pragma once

#include <pybind11/pybind11.h>

#include <vector>

#include "kalman/group.hpp"

namespace cgemit::bindings {

// `columns`: kind u8 (0 X, 1 V, 2 wire), layer i32 (CGEM index or the experiment's wire-layer number),
// element i32 (sheet or wire), size i32, value f8 (mm), sigma f8 (mm); each of length n. Throws on what the
// detector has not.
std::vector<Hit> make_hits(const Detector& detector, const pybind11::dict& columns, pybind11::ssize_t n);

// A row of (dr, phi0, kappa, dz, tanl).
Perigee from_bes3(const double* row);

}  // namespace cgemit::bindings

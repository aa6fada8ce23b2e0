// Particles in a straight line through a stack of slabs: the effect of the matter alone.
#pragma once

#include <cstdint>
#include <tuple>
#include <vector>

#include "common/columns.hpp"
#include "common/status.hpp"
#include "detector/detector.hpp"
#include "matter/kinematics.hpp"

namespace cgemit {

// One row per particle, after the stack. Plane angles and shifts (relative to the unscattered line) in the
// two planes across the flight.
struct SlabResults {
  std::vector<double> angle_1, angle_2;  // rad
  std::vector<double> shift_1, shift_2;  // mm
  std::vector<double> loss;              // GeV, all of the kinetic energy if stopped
  std::vector<TransportStatus> status;   // outside, stopped, or curled: turned back

  static constexpr auto columns() {
    return std::tuple(Column("angle_1", &SlabResults::angle_1), Column("angle_2", &SlabResults::angle_2),
                      Column("shift_1", &SlabResults::shift_1), Column("shift_2", &SlabResults::shift_2),
                      Column("loss", &SlabResults::loss), Column("status", &SlabResults::status));
  }
};

// Particles number `first` to `first` + n through the slabs of the detector, taken as plane layers at
// distances r_in to r_out and crossed at normal incidence.
SlabResults through_slabs(const Detector& detector, const Kinematics& incoming, std::uint64_t first,
                          std::size_t n, std::uint64_t seed);

}  // namespace cgemit

// The wire layers of a drift chamber, and what checks the parts of a detector.
#pragma once

#include <pybind11/pybind11.h>

#include <cstddef>
#include <string>
#include <vector>

#include "common/problems.hpp"
#include "detector/detector.hpp"

namespace cgemit::bindings {

// The wire layers of a drift chamber, in place.
struct Chamber {
  std::vector<WireLayer> layers;
};

// Adds a problem for every number of a part that is not in its range, ends included.
class Part {
 public:
  Part(Problems& problems, const char* name, std::size_t number)
      : problems_(problems), where_(name + ("[" + std::to_string(number) + "]")) {}
  void within(const char* name, double value, double low, double high) const {
    if (value >= low && value <= high) return;
    problems_.add(where_ + " " + name + ": got " + to_text(value) + ", expected " + to_text(low) + " to " +
                  to_text(high));
  }

 private:
  Problems& problems_;
  std::string where_;
};

// What the kernels divide by, index with and allocate; the description in Python has its own, narrower
// limits.
inline constexpr double far = 1e12, tiny = 1e-12;

std::vector<Placement> placements_of(const pybind11::dict& columns, std::size_t n);
std::vector<WireLayer> make_wires(const pybind11::dict& columns);
void check(Problems& problems, const std::vector<WireLayer>& wires);
// Wire layers that are checked with the rest of a detector; those of `make_chamber` were.
Chamber in_place(std::vector<WireLayer>&& layers, const pybind11::dict& columns);
Chamber make_chamber(const pybind11::dict& columns);

}  // namespace cgemit::bindings

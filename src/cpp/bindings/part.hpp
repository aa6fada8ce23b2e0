// Ranges of numbers that come from Python.
#pragma once

#include <cmath>
#include <cstddef>
#include <string>
#include <utility>

#include "common/problems.hpp"

namespace cgemit::bindings {

// Adds a problem for every number of a part of an input that is not in its range, ends included. NaN is in
// none.
class Part {
 public:
  Part(Problems& problems, std::string where) : problems_(problems), where_(std::move(where)) {}
  Part(Problems& problems, const char* name, std::size_t number)
      : Part(problems, name + ("[" + std::to_string(number) + "]")) {}
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

}  // namespace cgemit::bindings

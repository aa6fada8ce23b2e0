// For tests only: the functions of `common/lanes/math.hpp` by name.
#pragma once

#include <stdexcept>
#include <string>

#include "common/lanes/math.hpp"

namespace cgemit {

template <class T>
T function_by_name(const std::string& name, T x) {
  if (name == "log") return log(x);
  if (name == "exp") return exp(x);
  if (name == "sine") return sine_cosine(x).sine;
  if (name == "cosine") return sine_cosine(x).cosine;
  if (name == "sine_over") return SineOver<T>(x).sine_over;
  if (name == "cosine_beside") return SineOver<T>(x).cosine;
  if (name == "atan") return atan(x);
  if (name == "azimuth") return atan2(sine_cosine(x).sine, sine_cosine(x).cosine);
  if (name == "nearest") return nearest(x);
  throw std::invalid_argument(name + ": no such function");
}

template <class T>
void function_of_lanes(const std::string& name, const double* in, double* out, std::size_t n) {
  for (std::size_t i = 0; i + lanes_of<T> <= n; i += lanes_of<T>) {
    T x;
    for (int k = 0; k < lanes_of<T>; ++k) set_lane(x, k, in[i + static_cast<std::size_t>(k)]);
    const T y = function_by_name(name, x);
    for (int k = 0; k < lanes_of<T>; ++k) out[i + static_cast<std::size_t>(k)] = lane(y, k);
  }
}

}  // namespace cgemit

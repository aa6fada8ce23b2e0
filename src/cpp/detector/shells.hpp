// Neighbouring shells of matter as one scatterer.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "detector/detector.hpp"

namespace cgemit {

// What a material adds to a slab.
struct Material {
  double x0;                                 // mm
  double xi;                                 // GeV/mm
  std::array<double, loss_points> log_term;  // -2 ln(I/GeV) - delta - 2 C/Z on the grid of the tables
  std::vector<Component> components;         // of 1 mm
  std::vector<std::int64_t> elements;        // a number for each component, the same for equal elements
};

struct MaterialShell {
  const Material* material;
  double r_in, r_out;  // mm
};

// Numbers of a slab as in `Slab`; `log_terms` are averaged with xi.
struct ShellSums {
  double radius, spread, x0, xi;
  std::vector<double> log_terms;
  std::vector<Component> components;
};

ShellSums sum_shells(std::span<const MaterialShell> shells);

}  // namespace cgemit

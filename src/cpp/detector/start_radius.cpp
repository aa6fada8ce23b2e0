#include "detector/start_radius.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace cgemit {

namespace {

// Number of slabs inside of the radius, with its sign.
int slabs_inside(const Detector& detector, double radius) {
  const auto inside = [&](const Slab& slab) { return slab.radius < std::abs(radius); };
  const auto count = static_cast<int>(std::ranges::count_if(detector.slabs, inside));
  return radius < 0 ? -count : count;
}

// Scales the matter of a slab, as far as the fit reads it.
void weigh(Slab& slab, double weight) {
  slab.x0 *= weight;
  slab.xi *= weight;
  for (Component& one : slab.components) one.moles *= weight;
  slab.chi_c2 *= weight;
  slab.chi_c2_electrons *= weight;
  if (weight > 0) return;
  slab.chi_c2 = slab.chi_c2_electrons = 1e-30;  // logarithms must exist, as in `matter/scattering.cpp`
  for (SlabPoint& point : slab.table) point.log_screening = 0;
}

}  // namespace

Detector beginning_at(const Detector& detector, double radius) {
  std::vector<Slab> slabs = detector.slabs;
  for (Slab& slab : slabs)
    if (slab.radius < std::abs(radius)) weigh(slab, radius > 0 ? 0 : 2);
  Detector begun =
      make_detector(detector.field, std::move(slabs), detector.layers, detector.wires, detector.gaps);
  begun.loss = detector.loss;
  begun.errors = detector.errors;
  return begun;
}

StartRadii::StartRadii(const Detector& detector, std::size_t tracks, std::span<const double> radii)
    : of_track_(tracks, &detector) {
  for (std::size_t track = 0; track < radii.size(); ++track) {
    const int inside = radii[track] == 0 ? 0 : slabs_inside(detector, radii[track]);
    if (inside == 0) continue;
    auto known = begun_.find(inside);
    if (known == begun_.end()) known = begun_.emplace(inside, beginning_at(detector, radii[track])).first;
    of_track_[track] = &known->second;
  }
}

std::size_t StartRadii::alike(std::size_t first, std::size_t last) const {
  const auto begin = of_track_.begin() + static_cast<std::ptrdiff_t>(first),
             end = of_track_.begin() + static_cast<std::ptrdiff_t>(last);
  return static_cast<std::size_t>(
      std::find_if(begin, end, [&](const Detector* one) { return one != *begin; }) - begin);
}

}  // namespace cgemit

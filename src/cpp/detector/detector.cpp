#include "detector/detector.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "detector/wires.hpp"

namespace cgemit {

Detector make_detector(double bz, std::vector<Slab> slabs, std::vector<CgemLayer> cgem,
                       std::vector<WireLayer> wires) {
  Detector detector{bz, std::move(slabs), std::move(cgem), std::move(wires), {}};
  for (WireLayer& layer : detector.wires) {
    layer.placed.clear();
    for (int i = 0; i < layer.cells; ++i) layer.placed.push_back(place_wire(layer, i));
  }
  for (std::size_t i = 0; i < detector.slabs.size(); ++i) {
    detector.places.push_back({detector.slabs[i].radius, true, static_cast<int>(i)});
  }
  for (std::size_t i = 0; i < detector.wires.size(); ++i) {
    detector.places.push_back({wire_radius(detector.wires[i], 0.0), false, static_cast<int>(i)});
  }
  std::ranges::stable_sort(detector.places, {}, &Place::radius);
  return detector;
}

}  // namespace cgemit

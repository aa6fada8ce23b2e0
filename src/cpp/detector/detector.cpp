#include "detector/detector.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "common/units.hpp"
#include "detector/placement.hpp"
#include "detector/wires.hpp"

namespace cgemit {

namespace {

bool is_displaced(const EndShift& end) { return end.x != 0 || end.y != 0 || end.rotation != 0; }

// A wire of the layer, moved with it and then with the chamber.
Wire moved_with(const WireLayer& layer, const Placement& chamber, Wire wire) {
  if (layer.placement.moved) wire = moved(layer.placement, wire);
  return chamber.moved ? moved(chamber, wire) : wire;
}

// Every wire is the first one, turned about the beam line, unless ends of wires are displaced. The sine
// and cosine of the turn follow from those of the wire before.
PlacedWires wires_of(const WireLayer& layer, const Placement& chamber) {
  const bool alike = !is_displaced(layer.east) && !is_displaced(layer.west) && layer.shifts.empty();
  const Wire first = place_wire(layer, 0);
  const double step = 2 * pi / layer.cells, cosine = std::cos(step), sine = std::sin(step);
  std::vector<Wire> placed;
  placed.reserve(static_cast<std::size_t>(layer.cells));
  double c = 1, s = 0;
  for (int i = 0; i < layer.cells; ++i) {
    const Wire wire{c * first.x - s * first.y, s * first.x + c * first.y, c * first.ex - s * first.ey,
                    s * first.ex + c * first.ey, first.ez};
    placed.push_back(moved_with(layer, chamber, alike ? wire : place_wire(layer, i)));
    const double turned = cosine * c - sine * s;
    s = sine * c + cosine * s;
    c = turned;
  }
  return PlacedWires(std::move(placed));
}

std::vector<Extent> parts_of(const Detector& detector) {
  std::vector<Extent> parts;
  for (const Slab& slab : detector.slabs)
    if (slab.filler == Filler::none) parts.push_back({slab.radius, slab.ends});
  std::ranges::stable_sort(parts, {}, &Extent::radius);
  return parts;
}

// A layer borders the cells of its neighbours beyond its ends, too, unless the continued wires meet theirs.
void set_borders(WireLayer& inner, WireLayer& outer) {
  const double high = std::max(inner.ends.high, outer.ends.high),
               low = std::min(inner.ends.low, outer.ends.low);
  if (!(wire_radius(inner, high) < wire_radius(outer, high))) {
    WireLayer& shorter = inner.ends.high < outer.ends.high ? inner : outer;
    shorter.borders.high = shorter.ends.high;
  }
  if (!(wire_radius(inner, low) < wire_radius(outer, low))) {
    WireLayer& shorter = inner.ends.low > outer.ends.low ? inner : outer;
    shorter.borders.low = shorter.ends.low;
  }
}

double radius_of(const WireLayer& layer) { return wire_radius(layer, layer.middle); }

// Whether wires outside of a radius reach steeper lines from the origin than those up to it, at either end.
bool reopens(const std::vector<WireLayer>& wires, double radius) {
  std::array<double, 2> inside{}, outside{};
  for (const WireLayer& layer : wires) {
    const double r = radius_of(layer);
    std::array<double, 2>& steepest = r > radius ? outside : inside;
    steepest = {std::max(steepest[0], -layer.ends.low / r), std::max(steepest[1], layer.ends.high / r)};
  }
  return std::max(inside[0], inside[1]) > 0 && (outside[0] > inside[0] || outside[1] > inside[1]);
}

}  // namespace

double last_measurement(const Detector& detector) {
  double last = detector.layers.empty() && detector.wires.empty() ? HUGE_VAL : 0;
  for (const MeasuringLayer& layer : detector.layers) last = std::max(last, layer.r_readout);
  for (const WireLayer& layer : detector.wires) last = std::max(last, std::sqrt(layer.waist));
  return last;
}

bool has_equal_ends(const Detector& detector) {
  const auto equal = [](const auto& part) { return part.ends.low == -part.ends.high; };
  return std::ranges::all_of(detector.slabs, equal) && std::ranges::all_of(detector.layers, equal) &&
         std::ranges::all_of(detector.wires, equal);
}

double slope_through_most(const Detector& detector) {
  std::vector<Ends> slopes;
  const auto add = [&slopes](const Ends& ends, double r) { slopes.push_back({ends.low / r, ends.high / r}); };
  for (const MeasuringLayer& layer : detector.layers) add(layer.ends, layer.r_mid());
  for (const WireLayer& layer : detector.wires) add(layer.ends, radius_of(layer));
  double best = 0;
  std::ptrdiff_t most = 0;
  for (const Ends& first : slopes) {
    double end = first.high;
    std::ptrdiff_t crossed = 0;
    for (const Ends& one : slopes) {
      if (!one.hold(first.low)) continue;
      ++crossed;
      end = std::min(end, one.high);
    }
    if (crossed <= most) continue;
    most = crossed;
    best = 0.5 * (first.low + end);
  }
  return best;
}

void place_wires(std::vector<WireLayer>& layers, const Placement& chamber) {
  for (WireLayer& layer : layers) {
    layer.half_length = layer.ends.half();
    layer.middle = layer.ends.middle();
    const double c = std::cos(0.5 * layer.twist), s = std::sin(0.5 * layer.twist), r = layer.r_end;
    layer.waist = r * r * c * c;
    layer.flare = r * r * s * s / (layer.half_length * layer.half_length);
    layer.tan_half_twist = s / c;
    layer.per_radian = layer.cells / (2 * pi);
    layer.twist_per_z = layer.tan_half_twist / layer.half_length;
    layer.placed = wires_of(layer, chamber);
  }
  for (std::size_t i = 1; i < layers.size(); ++i) set_borders(layers[i - 1], layers[i]);
}

Detector make_detector(FieldMap field, std::vector<Slab> slabs, std::vector<MeasuringLayer> layers,
                       std::vector<WireLayer> wires, std::vector<GapMatter> gaps) {
  const double bz = field.bz;
  Detector detector{
      bz, std::move(field), std::move(slabs), std::move(layers), std::move(wires), std::move(gaps), {}, {},
      {}};
  for (Slab& slab : detector.slabs) {
    slab.least_outward = std::sqrt(0.5 * (slab.r_out - slab.r_in) * slab.radius);
    slab.shifts = slab.spread * 13.6 * MeV * std::sqrt(slab.x0) > 5 * um;
  }
  for (MeasuringLayer& layer : detector.layers) {
    layer.cos_stereo = std::cos(layer.stereo);
    layer.sin_stereo = std::sin(layer.stereo) / (1 + layer.z_scale);
  }
  for (std::size_t i = 0; i < detector.slabs.size(); ++i) {
    detector.surfaces.push_back({detector.slabs[i].radius, true, static_cast<int>(i)});
  }
  for (std::size_t i = 0; i < detector.wires.size(); ++i) {
    detector.surfaces.push_back({radius_of(detector.wires[i]), false, static_cast<int>(i)});
  }
  std::ranges::stable_sort(detector.surfaces, {}, &Surface::radius);
  detector.parts = parts_of(detector);
  for (Slab& slab : detector.slabs) {
    const auto outside = std::ranges::upper_bound(detector.parts, slab.radius, {}, &Extent::radius);
    slab.parts_inside = static_cast<std::size_t>(outside - detector.parts.begin());
    slab.reopens = slab.filler == Filler::chamber_gas && reopens(detector.wires, slab.r_out + 1e-6);
    slab.slopes_beyond = {0, 0};
    for (auto part = outside; part != detector.parts.end(); ++part) {
      slab.slopes_beyond.low = std::min(slab.slopes_beyond.low, part->ends.low / part->radius);
      slab.slopes_beyond.high = std::max(slab.slopes_beyond.high, part->ends.high / part->radius);
    }
  }
  return detector;
}

}  // namespace cgemit

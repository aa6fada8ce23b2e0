#include "bindings/chamber.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "bindings/arrays.hpp"
#include "common/angles.hpp"

namespace py = pybind11;

namespace cgemit::bindings {

// A column with the placement of n parts: shift, then the rows of the rotation. Without it the parts are in
// place.
std::vector<Placement> placements_of(const py::dict& columns, std::size_t n, const char* name) {
  std::vector<Placement> found(n);
  if (!columns.contains(name)) return found;
  const auto column = take<double>(columns, name);
  const auto rows = matrix(column, name, static_cast<py::ssize_t>(n), 12);
  for (std::size_t i = 0; i < n; ++i) {
    const auto row = rows.subspan(12 * i, 12);
    std::ranges::copy(row.first(3), found[i].shift.begin());
    std::ranges::copy(row.last(9), found[i].turn.begin());
    found[i].moved = found[i].shift != Placement().shift || found[i].turn != Placement().turn;
  }
  return found;
}

std::vector<WireLayer> make_wires(const py::dict& columns) {
  const auto number = take<std::int32_t>(columns, "number"), cells = take<std::int32_t>(columns, "cells"),
             gid_first = take<std::int32_t>(columns, "gid_first");
  const auto r_end = take<double>(columns, "r_end"), z_min = take<double>(columns, "z_min"),
             z_max = take<double>(columns, "z_max"), twist = take<double>(columns, "twist"),
             phi_east = take<double>(columns, "phi_east"), sigma = take<double>(columns, "sigma"),
             sigma_slope = take<double>(columns, "sigma_slope"),
             efficiency = take<double>(columns, "efficiency");
  const auto n = static_cast<std::size_t>(number.size());
  std::vector<WireLayer> layers(n);
  for (std::size_t i = 0; i < n; ++i) {
    WireLayer& layer = layers[i];
    layer.number = number.at(i);
    layer.cells = cells.at(i);
    layer.r_end = r_end.at(i);
    layer.ends = {z_min.at(i), z_max.at(i)};
    layer.twist = twist.at(i);
    layer.phi_east = phi_east.at(i);
    layer.sigma = sigma.at(i);
    layer.sigma_slope = sigma_slope.at(i);
    layer.efficiency = efficiency.at(i);
    layer.gid_first = gid_first.at(i);
  }
  const auto of_layer = [&](const Array<std::int32_t>& rows, py::ssize_t i) -> WireLayer& {
    return layers.at(static_cast<std::size_t>(rows.at(i)));
  };
  if (columns.contains("ramp_layer")) {
    const auto layer = take<std::int32_t>(columns, "ramp_layer");
    const auto from = take<double>(columns, "ramp_from"), change = take<double>(columns, "ramp_change");
    for (py::ssize_t i = 0; i < layer.size(); ++i)
      of_layer(layer, i).ramps.push_back({from.at(i), change.at(i)});
  }
  const auto point_layer = take<std::int32_t>(columns, "point_layer");
  const auto distance = take<double>(columns, "point_distance"), time = take<double>(columns, "point_time");
  for (py::ssize_t i = 0; i < point_layer.size(); ++i)
    of_layer(point_layer, i).relation.push_back({distance.at(i), time.at(i)});
  if (columns.contains("masked_layer")) {
    const auto layer = take<std::int32_t>(columns, "masked_layer"),
               wire = take<std::int32_t>(columns, "masked_wire");
    for (py::ssize_t i = 0; i < layer.size(); ++i) {
      WireLayer& its = of_layer(layer, i);
      its.masked.resize(static_cast<std::size_t>(std::max(its.cells, 0)));
      its.masked.at(static_cast<std::size_t>(wire.at(i))) = 1;
    }
  }
  if (columns.contains("end_shift")) {
    const auto column = take<double>(columns, "end_shift");
    const auto rows = matrix(column, "end_shift", static_cast<py::ssize_t>(n), 6);
    for (std::size_t i = 0; i < n; ++i) {
      const auto row = rows.subspan(6 * i, 6);
      layers[i].east = {row[0], row[1], row[2]};
      layers[i].west = {row[3], row[4], row[5]};
    }
  }
  const auto placements = placements_of(columns, n, "layer_placement");
  for (std::size_t i = 0; i < n; ++i) layers[i].placement = placements[i];
  return layers;
}

void check(Problems& problems, const std::vector<WireLayer>& wires) {
  constexpr double most_cells = 1e6, most_layers = 65535;
  for (std::size_t i = 0; i < wires.size(); ++i) {
    const Part part(problems, "wires", i);
    part.within("number", wires[i].number, 0, most_layers);
    part.within("cells", wires[i].cells, 1, most_cells);
    part.within("r_end", wires[i].r_end, tiny, far);
    part.within("z_min", wires[i].ends.low, -far, far);
    part.within("z_max", wires[i].ends.high, wires[i].ends.low + tiny, far);
    part.within("twist", std::abs(wires[i].twist), 0, pi);
    part.within("phi_east", wires[i].phi_east, -far, far);
    part.within("sigma", wires[i].sigma, 0, far);
    part.within("sigma_slope", wires[i].sigma_slope, -far, far);
    part.within("efficiency", wires[i].efficiency, 0, 1);
    for (const EndShift& end : {wires[i].east, wires[i].west})
      for (const double one : {end.x, end.y, end.rotation}) part.within("end_shift", one, -far, far);
    const std::vector<DriftPoint>& points = wires[i].relation;
    part.within("points of the relation", static_cast<double>(points.size()), 2, far);
    for (std::size_t k = 0; k < points.size(); ++k) {
      part.within("point_distance", points[k].distance, k == 0 ? 0 : points[k - 1].distance + tiny, far);
      part.within("point_time", points[k].time, k == 0 ? -far : points[k - 1].time + tiny, far);
    }
  }
}

Chamber in_place(std::vector<WireLayer>&& layers, const py::dict& columns) {
  place_wires(layers, placements_of(columns, 1, "placement").front());
  return {std::move(layers)};
}

Chamber make_chamber(const py::dict& columns) {
  std::vector<WireLayer> layers = make_wires(columns);
  Problems problems;
  check(problems, layers);
  problems.raise("detector");
  return in_place(std::move(layers), columns);
}

}  // namespace cgemit::bindings

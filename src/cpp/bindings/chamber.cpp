#include "bindings/chamber.hpp"

#include <cmath>
#include <utility>

#include "bindings/arrays.hpp"
#include "common/angles.hpp"

namespace py = pybind11;

namespace cgemit::bindings {

// Column `placement` of n parts: shift, then the rows of the rotation. Without it the parts are in place.
std::vector<Placement> placements_of(const py::dict& columns, std::size_t n) {
  std::vector<Placement> found(n);
  if (!columns.contains("placement")) return found;
  const auto column = take<double>(columns, "placement");
  const auto rows = matrix(column, "placement", static_cast<py::ssize_t>(n), 12);
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
  const auto r_end = take<double>(columns, "r_end"), half_length = take<double>(columns, "half_length"),
             twist = take<double>(columns, "twist"), phi_east = take<double>(columns, "phi_east"),
             sigma = take<double>(columns, "sigma"), sigma_slope = take<double>(columns, "sigma_slope"),
             efficiency = take<double>(columns, "efficiency");
  const auto n = static_cast<std::size_t>(number.size());
  std::vector<WireLayer> layers(n);
  for (std::size_t i = 0; i < n; ++i) {
    WireLayer& layer = layers[i];
    layer.number = number.at(i);
    layer.cells = cells.at(i);
    layer.r_end = r_end.at(i);
    layer.half_length = half_length.at(i);
    layer.twist = twist.at(i);
    layer.phi_east = phi_east.at(i);
    layer.sigma = sigma.at(i);
    layer.sigma_slope = sigma_slope.at(i);
    layer.efficiency = efficiency.at(i);
    layer.gid_first = gid_first.at(i);
  }
  if (columns.contains("ramp_layer")) {
    const auto layer = take<std::int32_t>(columns, "ramp_layer");
    const auto from = take<double>(columns, "ramp_from"), change = take<double>(columns, "ramp_change");
    for (py::ssize_t i = 0; i < layer.size(); ++i)
      layers.at(static_cast<std::size_t>(layer.at(i))).ramps.push_back({from.at(i), change.at(i)});
  }
  return layers;
}

void check(Problems& problems, const std::vector<WireLayer>& wires) {
  constexpr double most_cells = 1e6, most_layers = 65535;
  for (std::size_t i = 0; i < wires.size(); ++i) {
    const Part part(problems, "wires", i);
    part.within("number", wires[i].number, 0, most_layers);
    part.within("cells", wires[i].cells, 1, most_cells);
    part.within("r_end", wires[i].r_end, tiny, far);
    part.within("half_length", wires[i].half_length, tiny, far);
    part.within("twist", std::abs(wires[i].twist), 0, pi);
    part.within("phi_east", wires[i].phi_east, -far, far);
    part.within("sigma", wires[i].sigma, 0, far);
    part.within("sigma_slope", wires[i].sigma_slope, -far, far);
    part.within("efficiency", wires[i].efficiency, 0, 1);
  }
}

Chamber in_place(std::vector<WireLayer>&& layers, const py::dict& columns) {
  place_wires(layers, placements_of(columns, 1).front());
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

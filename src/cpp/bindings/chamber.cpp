#include "bindings/chamber.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <tuple>
#include <utility>

#include "bindings/fields.hpp"
#include "common/angles.hpp"

namespace py = pybind11;

namespace cgemit::bindings {

namespace {

// Rows of the layers: their numbers, counted from 0, and what belongs to them.
struct RampRow {
  std::int32_t layer;
  ErrorRamp ramp;

  static constexpr auto columns() {
    return std::tuple(Column("ramp_layer", &RampRow::layer), Column("ramp_", &RampRow::ramp));
  }
};
struct PointRow {
  std::int32_t layer;
  DriftPoint point;

  static constexpr auto columns() {
    return std::tuple(Column("point_layer", &PointRow::layer), Column("point_", &PointRow::point));
  }
};
struct MaskedRow {
  std::int32_t layer, wire;

  static constexpr auto columns() {
    return std::tuple(Column("masked_layer", &MaskedRow::layer), Column("masked_wire", &MaskedRow::wire));
  }
};
struct ShiftRow {
  std::int32_t layer, wire;
  WireShift shift;

  static constexpr auto columns() {
    return std::tuple(Column("single_layer", &ShiftRow::layer), Column("single_wire", &ShiftRow::wire),
                      Column("single_", &ShiftRow::shift));
  }
};
// The chamber as a whole.
struct ChamberRow {
  Placement placement;

  static constexpr auto columns() { return std::tuple(Column("chamber_", &ChamberRow::placement)); }
};

}  // namespace

void set_moved(Placement& placement) {
  placement.moved = placement.shift != Placement().shift || placement.turn != Placement().turn;
}

WireTable read_wires(const py::dict& columns, Problems& problems) {
  WireTable table{.layers = Inputs(columns, "wires").read_rows<WireLayer>(problems), .chamber = {}};
  const auto ramps = Inputs(columns, "wires").read_rows<RampRow>(problems);
  const auto points = Inputs(columns, "wires").read_rows<PointRow>(problems);
  const auto masked = Inputs(columns, "wires").read_rows<MaskedRow>(problems);
  const auto shifts = Inputs(columns, "wires").read_rows<ShiftRow>(problems);
  const auto chamber = Inputs(columns, "wires", 1).read_rows<ChamberRow>(problems);
  if (!problems.empty()) return table;
  const auto of_layer = [&](std::int32_t layer) -> WireLayer& {
    return table.layers.at(static_cast<std::size_t>(layer));
  };
  for (const RampRow& row : ramps) of_layer(row.layer).ramps.push_back(row.ramp);
  for (const PointRow& row : points) of_layer(row.layer).relation.push_back(row.point);
  for (const MaskedRow& row : masked) {
    WireLayer& its = of_layer(row.layer);
    its.masked.resize(static_cast<std::size_t>(std::max(its.cells, 0)));
    its.masked.at(static_cast<std::size_t>(row.wire)) = 1;
  }
  for (const ShiftRow& row : shifts) {
    WireLayer& its = of_layer(row.layer);
    its.shifts.resize(static_cast<std::size_t>(std::max(its.cells, 0)));
    its.shifts.at(static_cast<std::size_t>(row.wire)) = row.shift;
  }
  table.chamber = chamber.front().placement;
  set_moved(table.chamber);
  for (WireLayer& layer : table.layers) set_moved(layer.placement);
  return table;
}

void check(Problems& problems, const WireTable& table) {
  constexpr double most_cells = 1e6, most_layers = 65535;
  const std::vector<WireLayer>& wires = table.layers;
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
      for (const double one : {end.x, end.y, end.rotation}) part.within("east, west", one, -far, far);
    for (const WireShift& shift : wires[i].shifts)
      for (const double one : {shift.east.r, shift.east.phi, shift.west.r, shift.west.phi})
        part.within("single wires", one, -far, far);
    const std::vector<DriftPoint>& points = wires[i].relation;
    part.within("points of the relation", static_cast<double>(points.size()), 2, far);
    for (std::size_t k = 0; k < points.size(); ++k) {
      part.within("point_distance", points[k].distance, k == 0 ? 0 : points[k - 1].distance + tiny, far);
      part.within("point_time", points[k].time, k == 0 ? -far : points[k - 1].time + tiny, far);
    }
  }
}

Chamber in_place(WireTable&& table) {
  place_wires(table.layers, table.chamber);
  return {std::move(table.layers)};
}

Chamber make_chamber(const py::dict& columns) {
  Problems problems;
  WireTable table = read_wires(columns, problems);
  problems.raise("detector");
  check(problems, table);
  problems.raise("detector");
  return in_place(std::move(table));
}

}  // namespace cgemit::bindings

#include <pybind11/pybind11.h>

#include <stdexcept>

#include "bindings/arrays.hpp"
#include "motion/helix.hpp"
#include "motion/wire.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

constexpr py::ssize_t width = 7;  // x y z ux uy tanl w

HelixPoint load(const double* row) { return {row[0], row[1], row[2], row[3], row[4], row[5], row[6]}; }

void store(const HelixPoint& p, std::vector<double>& out) {
  for (const double value : {p.x, p.y, p.z, p.ux, p.uy, p.tanl, p.w}) out.push_back(value);
}

py::tuple to_cylinder(const Array<double>& points, double radius, bool outward) {
  const py::ssize_t n = points.ndim() == 2 ? points.shape(0) : 0;
  const auto rows = matrix(points, "points", n, width);
  std::vector<double> moved, arcs;
  std::vector<std::uint8_t> reached;
  for (py::ssize_t i = 0; i < n; ++i) {
    HelixPoint point = load(rows.data() + width * i);
    double arc = 0;
    reached.push_back(step_to_cylinder(point, radius, arc, outward));
    arcs.push_back(arc);
    store(point, moved);
  }
  return py::make_tuple(to_numpy(std::move(moved), {n, width}), to_numpy(std::move(arcs)),
                        to_numpy(std::move(reached)));
}

py::tuple along(const Array<double>& points, const Array<double>& arcs) {
  const py::ssize_t n = points.ndim() == 2 ? points.shape(0) : 0;
  const auto rows = matrix(points, "points", n, width);
  const auto steps = column(arcs, "arcs", n);
  std::vector<double> moved, apex;
  for (py::ssize_t i = 0; i < n; ++i) {
    HelixPoint point = load(rows.data() + width * i);
    apex.push_back(arc_to_apex(point));
    advance(point, steps[static_cast<std::size_t>(i)]);
    store(point, moved);
  }
  return py::make_tuple(to_numpy(std::move(moved), {n, width}), to_numpy(std::move(apex)));
}

py::tuple to_wire(const Array<double>& points, const Detector& detector, int layer, int wire) {
  const py::ssize_t n = points.ndim() == 2 ? points.shape(0) : 0;
  const auto rows = matrix(points, "points", n, width);
  const WireLayer& cells = detector.wires.at(static_cast<std::size_t>(layer));
  const Wire& line = cells.placed.at(static_cast<std::size_t>(wire));
  std::vector<double> moved, doca, arcs;
  std::vector<std::uint8_t> found;
  for (py::ssize_t i = 0; i < n; ++i) {
    HelixPoint point = load(rows.data() + width * i);
    Approach approach{};
    found.push_back(approach_wire(point, line, approach));
    doca.push_back(approach.doca);
    arcs.push_back(approach.arc);
    store(point, moved);
  }
  return py::make_tuple(to_numpy(std::move(moved), {n, width}), to_numpy(std::move(doca)),
                        to_numpy(std::move(arcs)), to_numpy(std::move(found)));
}

}  // namespace

void bind_motion(py::module_& module) {
  testing(module).def(
      "step_to_cylinder", &to_cylinder, py::arg("points"), py::arg("radius"), py::kw_only(),
      py::arg("outward") = true,
      "Move helix points, rows of (x y z ux uy tanl w), to a cylinder: points, arcs, whether reached.");
  testing(module).def(
      "advance", &along, py::arg("points"), py::arg("arcs"),
      "Move helix points by transverse arcs: points, and the arc from each to its outermost point.");
  testing(module).def(
      "approach_wire", &to_wire, py::arg("points"), py::arg("detector"), py::arg("layer"), py::arg("wire"),
      "Move helix points to their closest approach to a wire: points, signed distances, arcs, whether "
      "found.");
}

#include "detector/field/field.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

#include "bindings/arrays.hpp"
#include "motion/field_motion.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

constexpr int most_points = 100'000;  // of an axis

FieldMap make_field(double bz, double tolerance, double b, double q,
                    const std::vector<std::tuple<double, double, int>>& axes,
                    const Array<double>& coefficients, std::optional<std::array<double, 2>> reach,
                    bool polar) {
  const bool numbers = std::isfinite(bz) && std::isfinite(b) && std::isfinite(q);
  if (!numbers || !(tolerance > 0 && tolerance < HUGE_VAL))
    throw std::invalid_argument("bz, b, q, tolerance: expected finite numbers, tolerance above 0");
  if (reach && !((*reach)[0] > 0 && (*reach)[1] > 0 && (*reach)[0] + (*reach)[1] < HUGE_VAL))
    throw std::invalid_argument("reach: expected two finite lengths above 0");
  if (axes.empty()) {
    FieldMap map{FieldKind::harmonic, bz, b, q, {}, {}, tolerance};
    if (reach) map.axes = {{0, (*reach)[0], 2}, {-(*reach)[1], 2 * (*reach)[1], 2}};
    return map;
  }
  if (axes.size() != 2 && axes.size() != 3) throw std::invalid_argument("axes: expected two or three");
  if (polar && axes.size() != 3) throw std::invalid_argument("axes: expected three of a map in r, phi, z");
  if (polar && !(std::get<0>(axes[0]) >= 0 && std::abs(std::get<0>(axes[1])) < 3.2))
    throw std::invalid_argument("axes: expected r from 0 and phi from -pi or later");
  const FieldKind kind = polar ? FieldKind::polar : axes.size() == 3 ? FieldKind::box : FieldKind::cylinder;
  FieldMap map{kind, bz, 0, 0, {}, {}, tolerance};
  std::size_t size = axes.size();
  for (const auto& [first, step, points] : axes) {
    if (points < 2 || points > most_points || !(step > 0 && step < HUGE_VAL) || !std::isfinite(first))
      throw std::invalid_argument("axes: expected 2 to 100000 points at a finite distance");
    map.axes.push_back({first, step, points});
    size *= static_cast<std::size_t>(points) + 2;  // below 2^53: three factors of 17 bits
  }
  const auto values = column(coefficients, "coefficients", static_cast<py::ssize_t>(size));
  if (!std::ranges::all_of(values, [](double value) { return std::isfinite(value); }))
    throw std::invalid_argument("coefficients: expected finite numbers");
  map.coefficients.assign(values.begin(), values.end());
  return map;
}

py::tuple values(const FieldMap& map, const Array<double>& points) {
  const py::ssize_t n = points.ndim() == 2 ? points.shape(0) : 0;
  const auto rows = matrix(points, "points", n, 3);
  std::vector<double> field, gradients;
  std::vector<std::uint8_t> inside;
  for (std::size_t i = 0; i < rows.size(); i += 3) {
    const Vec3<double> x{rows[i], rows[i + 1], rows[i + 2]};
    const auto& [b, slope] = map.at(x);
    field.insert(field.end(), {b.x, b.y, b.z});
    for (const Vec3<double>& row : {slope.x, slope.y, slope.z})
      gradients.insert(gradients.end(), {row.x, row.y, row.z});
    inside.push_back(map.holds(x));
  }
  return py::make_tuple(to_numpy(std::move(field), {n, 3}), to_numpy(std::move(gradients), {n, 3, 3}),
                        to_numpy(std::move(inside)));
}

py::tuple advance_points(const FieldMap& map, const Array<double>& points, const Array<double>& path_column,
                         const Array<double>& derivative_array) {
  const py::ssize_t n = points.ndim() == 2 ? points.shape(0) : 0;
  const auto rows = matrix(points, "points", n, 7);
  const auto paths = column(path_column, "paths", n);
  const auto start = matrix(derivative_array, "derivatives", 5, 5);
  using Derivatives = FieldDerivatives<double>;
  constexpr std::array order = {&Derivatives::across, &Derivatives::psi, &Derivatives::bend, &Derivatives::z,
                                &Derivatives::tanl};
  const auto scale = [](std::size_t row) { return row == 2 ? radius_per_kappa : 1.0; };
  std::vector<double> moved, derivatives;
  std::vector<std::uint8_t> inside;
  for (std::size_t i = 0; i < paths.size(); ++i) {
    const double* row = rows.data() + 7 * i;
    const Vec3<double> x{row[0], row[1], row[2]}, t{row[3], row[4], row[5]};
    FieldPoint<double> point{x, t, map.at(x)};
    Derivatives d;
    for (std::size_t k = 0; k < 5; ++k)
      for (std::size_t m = 0; m < 5; ++m) (d.*order[k])[m] = start[5 * k + m] / scale(k);
    const double bend = row[6] / radius_per_kappa;
    CarriedDerivatives<double> carried(d, t, point.field, bend);
    inside.push_back(RungeKutta<double>(map).advance(point, bend, paths[i], true, &carried));
    carried.finish(true);
    moved.insert(moved.end(), {point.x.x, point.x.y, point.x.z, point.t.x, point.t.y, point.t.z});
    for (std::size_t k = 0; k < 5; ++k)
      for (std::size_t m = 0; m < 5; ++m) derivatives.push_back((d.*order[k])[m] * scale(k));
  }
  return py::make_tuple(to_numpy(std::move(moved), {n, 6}), to_numpy(std::move(derivatives), {n, 5, 5}),
                        to_numpy(std::move(inside)));
}

py::tuple to_perigee(const FieldMap& map, const Array<double>& points) {
  const py::ssize_t n = points.ndim() == 2 ? points.shape(0) : 0;
  const auto rows = matrix(points, "points", n, 7);
  std::vector<double> moved;
  std::vector<std::uint8_t> reached;
  for (py::ssize_t i = 0; i < n; ++i) {
    const double* row = rows.data() + 7 * i;
    HelixPoint point{row[0], row[1], row[2], row[3], row[4], row[5], 0};
    FieldMotion motion(map);
    motion.bend(point, row[6]);
    reached.push_back(motion.to_perigee(point));
    for (const double value : {point.x, point.y, point.z, point.ux, point.uy, point.tanl})
      moved.push_back(value);
  }
  return py::make_tuple(to_numpy(std::move(moved), {n, 6}), to_numpy(std::move(reached)));
}

}  // namespace

void bind_field(py::module_& module) {
  py::class_<FieldMap>(module, "Field", "The magnetic field at a point.")
      .def(py::init(&make_field), py::kw_only(), py::arg("bz"), py::arg("tolerance"), py::arg("b") = 0.0,
           py::arg("q") = 0.0, py::arg("axes") = std::vector<std::tuple<double, double, int>>(),
           py::arg_v("coefficients", Array<double>(0), "[]"), py::arg("reach") = py::none(),
           py::arg("polar") = false)
      .def_readonly("bz", &FieldMap::bz)
      .def_property_readonly("is_uniform", &FieldMap::is_uniform)
      .def("values", &values, py::arg("points"),
           "Field and gradient at points (n, 3), and whether they lie inside the map.")
      .def("advance", &advance_points, py::arg("points"), py::arg("paths"), py::arg("derivatives"),
           "Move points, rows of (x y z, direction, charge/p), along paths, and propagate the derivatives "
           "(5, 5) of neighbours: to the left, azimuth, charge/p, up and slope, in the plane across the "
           "transverse flight.")
      .def("to_perigee", &to_perigee, py::arg("points"),
           "Move points, rows of (x y z ux uy tanl, charge/pT), to their closest approach to the beam line: "
           "points, and whether they lie inside the map.");
}

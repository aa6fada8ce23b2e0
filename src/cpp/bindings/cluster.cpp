#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/cluster_columns.hpp"
#include "bindings/inputs.hpp"
#include "reconstruction/cluster/charge_time.hpp"
#include "reconstruction/cluster/clusters.hpp"
#include "reconstruction/cluster/positions.hpp"
#include "reconstruction/cluster/size_errors.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

DigiView digi_view(Inputs& in) {
  DigiView digis;
  digis.event = in.get<std::int64_t>("event");
  digis.layer = in.get<std::int32_t>("layer");
  digis.sheet = in.get<std::int32_t>("sheet");
  digis.view = in.get<std::int8_t>("view");
  digis.strip = in.get<std::int32_t>("strip");
  digis.charge = in.get<double>("charge");
  digis.time = in.get<double>("time");
  digis.truth = in.get<std::int64_t>("truth");
  digis.n_truths = in.get<std::int32_t>("n_truths");
  return digis;
}

py::dict of_strips(const Detector& detector, const py::dict& table, const Array<double>& err_x,
                   const Array<double>& err_v, bool by_charge, const Array<std::int32_t>& masked,
                   std::int32_t bridge) {
  Inputs in(table, "event");
  const DigiView digis = digi_view(in);
  const auto layers = static_cast<py::ssize_t>(detector.cgem.size());
  const py::ssize_t sizes = err_x.ndim() == 2 ? err_x.shape(1) : 0;
  if (sizes < 1) throw std::invalid_argument("err_x: expected shape (layers, sizes)");
  const ErrorTable errors{matrix(err_x, "err_x", layers, sizes), matrix(err_v, "err_v", layers, sizes),
                          static_cast<std::size_t>(sizes)};
  const StripMask mask(detector, column(masked, "masked"), bridge);
  ClusterColumns found;
  {
    py::gil_scoped_release release;
    found = find_clusters(detector, digis, errors, by_charge ? Position::charge : Position::centre, mask);
  }
  return to_dict(std::move(found));
}

py::dict of_positions(const Detector& detector, const py::dict& table, double err_x, double err_v) {
  Inputs in(table, "event");
  DigiView digis = digi_view(in);
  digis.position = in.get<double>("position");
  ClusterColumns found;
  {
    py::gil_scoped_release release;
    found = clusters_of_positions(detector, digis, err_x, err_v);
  }
  return to_dict(std::move(found));
}

// Entry i of a column for each CGEM layer.
std::vector<LayerTiming> layer_timing(const py::dict& table, const Detector& detector) {
  Inputs in(table, "velocity");
  const auto velocity = in.get<double>("velocity"), tan_lorentz = in.get<double>("tan_lorentz"),
             shift = in.get<double>("shift"), delay = in.get<double>("delay");
  if (velocity.size() != detector.cgem.size()) {
    throw std::invalid_argument("timing: expected one row for each CGEM layer");
  }
  std::vector<LayerTiming> found;
  for (std::size_t i = 0; i < velocity.size(); ++i) {
    found.push_back({velocity[i], tan_lorentz[i], shift[i], delay[i]});
  }
  return found;
}

// An input of shape (rows, width).
std::span<const double> rows_of(const Array<double>& array, const char* name, std::size_t rows,
                                py::ssize_t width) {
  if (width < 1) throw std::invalid_argument(std::string(name) + ": expected rows with entries");
  return matrix(array, name, static_cast<py::ssize_t>(rows), width);
}

py::dict with_times(const Detector& detector, const py::dict& table, const py::dict& timing,
                    const Array<double>& delay_charge, const Array<double>& delay,
                    const Array<double>& errors, const Array<double>& shares, const Array<double>& depth,
                    const Array<double>& height, const Array<double>& edges, const std::string& estimator,
                    std::int32_t missing, double edge, const Array<std::int32_t>& masked, std::int32_t bridge,
                    const Array<double>& gain, double valley, double margin, const Array<double>& pairs,
                    const Array<double>& slope_errors, const Array<double>& slope_shares,
                    const Array<double>& slope_edges, const Array<double>& charge_factors,
                    const Array<double>& distance_edges, const Array<double>& distance_factors,
                    const Array<double>& direction_slopes, const Array<double>& direction_paths,
                    const Array<double>& direction_depths, const Array<double>& direction_factors,
                    const Array<double>& slopes, const Array<double>& paths) {
  Inputs in(table, "event");
  const DigiView digis = digi_view(in);
  const std::vector<LayerTiming> layers = layer_timing(timing, detector);
  const std::size_t n = detector.cgem.size();
  const py::ssize_t points = delay.ndim() == 2 ? delay.shape(1) : 0,
                    sizes = errors.ndim() == 2 ? errors.shape(1) : 0;
  const py::ssize_t charges = depth.ndim() == 2 ? depth.shape(1) : 0;
  const auto rows = static_cast<std::size_t>(std::max<py::ssize_t>(charges, 0));
  if (estimator != "merged" && estimator != "centroid" && estimator != "micro-tpc") {
    throw std::invalid_argument("estimator: got " + estimator + ", expected merged, centroid or micro-tpc");
  }
  const auto slope_rows = static_cast<py::ssize_t>(2 * n) * (slope_edges.size() + 1);
  const py::ssize_t slope_sizes =
      std::max<py::ssize_t>(1, slope_shares.size() / std::max<py::ssize_t>(slope_rows, 1));
  const py::ssize_t distances = distance_factors.ndim() == 2 ? distance_factors.shape(1) : 0;
  if (distances < 2) throw std::invalid_argument("distance_factors: expected rows with entries");
  if (direction_slopes.size() < 1 || direction_paths.size() < 1) {
    throw std::invalid_argument("direction_slopes, direction_paths: expected at least one");
  }
  const auto direction_entries =
      static_cast<py::ssize_t>(12 * n) * (direction_slopes.size() + direction_paths.size());
  const ChargeTimeModel model{
      .layers = layers,
      .delays = {rows_of(delay_charge, "delay_charge", 2 * n, points), rows_of(delay, "delay", 2 * n, points),
                 static_cast<std::size_t>(points)},
      .calibration = {rows_of(errors, "errors", 6 * n * rows, sizes),
                      rows_of(shares, "shares", 2 * n * rows, sizes), rows_of(depth, "depth", 2 * n, charges),
                      rows_of(height, "height", 2 * n, charges),
                      matrix(edges, "edges", static_cast<py::ssize_t>(2 * n), charges - 1), n, rows,
                      static_cast<std::size_t>(sizes)},
      .estimator = estimator == "merged"     ? Estimator::merged
                   : estimator == "centroid" ? Estimator::centroid
                                             : Estimator::micro_tpc,
      .missing = missing,
      .mask = StripMask(detector, column(masked, "masked"), bridge),
      .gain = column(gain, "gain", gain.size() == 0 ? 0 : strips_of(detector)),
      .edge = edge,
      .valley = valley,
      .margin = margin,
      .pairs = {column(pairs, "pairs",
                       pairs.size() == 0 ? 0 : static_cast<py::ssize_t>(n * PairTable::entries))},
      .slope_errors = {column(slope_errors, "slope_errors", 3 * slope_shares.size()),
                       column(slope_shares, "slope_shares", slope_rows * slope_sizes),
                       column(slope_edges, "slope_edges"), n, static_cast<std::size_t>(slope_sizes)},
      .factors = {column(charge_factors, "charge_factors", errors.size()),
                  matrix(distance_edges, "distance_edges", static_cast<py::ssize_t>(4 * n), distances - 2),
                  matrix(distance_factors, "distance_factors", static_cast<py::ssize_t>(12 * n), distances),
                  2 * n, static_cast<std::size_t>(distances)},
      .directions = {column(direction_slopes, "direction_slopes"), column(direction_paths, "direction_paths"),
                     column(direction_depths, "direction_depths", direction_entries),
                     column(direction_factors, "direction_factors", direction_entries), 2 * n},
      .slopes = column(slopes, "slopes", slopes.size()),
      .paths = column(paths, "paths", slopes.size())};
  ClusterColumns found;
  {
    py::gil_scoped_release release;
    found = find_charge_time_clusters(detector, digis, model);
  }
  return to_dict(std::move(found));
}

py::array_t<double> errors_of_sizes(const Array<double>& extents, double pitch, std::size_t sizes) {
  return to_numpy(size_errors(column(extents, "extents"), pitch, sizes));
}

}  // namespace

void bind_cluster(py::module_& module) {
  module.def("find_clusters", &of_strips, py::arg("detector"), py::arg("digis"), py::kw_only(),
             py::arg("err_x"), py::arg("err_v"), py::arg("by_charge"),
             py::arg_v("masked", Array<std::int32_t>(0), "..."), py::arg("bridge") = 0,
             "Columns of clusters from columns of digis: contiguous strips.");
  module.def("clusters_of_positions", &of_positions, py::arg("detector"), py::arg("digis"), py::kw_only(),
             py::arg("err_x"), py::arg("err_v"),
             "Columns of clusters from columns of digis: read-out without strips.");
  module.def("find_charge_time_clusters", &with_times, py::arg("detector"), py::arg("digis"), py::kw_only(),
             py::arg("timing"), py::arg("delay_charge"), py::arg("delay"), py::arg("errors"),
             py::arg("shares"), py::arg("depth"), py::arg("height"), py::arg("edges"), py::arg("estimator"),
             py::arg("missing"), py::arg("edge"), py::arg_v("masked", Array<std::int32_t>(0), "..."),
             py::arg("bridge") = 0, py::arg_v("gain", Array<double>(0), "..."), py::arg("valley") = 0.0,
             py::arg("margin"), py::arg_v("pairs", Array<double>(0), "..."), py::arg("slope_errors"),
             py::arg("slope_shares"), py::arg("slope_edges"), py::arg("charge_factors"),
             py::arg("distance_edges"), py::arg("distance_factors"), py::arg("direction_slopes"),
             py::arg("direction_paths"), py::arg("direction_depths"), py::arg("direction_factors"),
             py::arg_v("slopes", Array<double>(0), "..."), py::arg_v("paths", Array<double>(0), "..."),
             "Columns of clusters from columns of digis: charge centroid and line fit.");
  module.def(
      "size_errors", &errors_of_sizes, py::arg("extents"), py::arg("pitch"), py::arg("sizes"),
      "RMS of the position error (mm) of clusters of 1 to `sizes` strips for a sample of extents (mm).");
}

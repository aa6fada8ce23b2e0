#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/fields.hpp"
#include "bindings/settings.hpp"
#include "reconstruction/cluster/charge_time.hpp"
#include "reconstruction/cluster/clusters.hpp"
#include "reconstruction/cluster/positions.hpp"
#include "reconstruction/cluster/size_errors.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

py::dict of_strips(const Detector& detector, const py::dict& table, const Array<double>& err_x,
                   const Array<double>& err_v, bool by_charge, const Array<std::int32_t>& masked,
                   std::int32_t bridge) {
  Inputs in(table, "digis");
  const auto digis = in.read<DigiView>();
  const auto layers = static_cast<py::ssize_t>(detector.layers.size());
  const py::ssize_t sizes = err_x.ndim() == 2 ? err_x.shape(1) : 0;
  if (sizes < 1) throw std::invalid_argument("err_x: expected shape (layers, sizes)");
  const ErrorTable errors{matrix(err_x, "err_x", layers, sizes), matrix(err_v, "err_v", layers, sizes),
                          static_cast<std::size_t>(sizes)};
  const StripMask mask(detector, column(masked, "masked"), bridge);
  Columns<ClusterRow> found;
  {
    py::gil_scoped_release release;
    found = find_clusters(detector, digis, errors, by_charge ? Position::charge : Position::centre, mask);
  }
  return to_dict(std::move(found));
}

py::dict of_positions(const Detector& detector, const py::dict& table, const py::dict& errors) {
  Inputs in(table, "digis");
  auto digis = in.read<DigiView>();
  digis.position = in.get<double>("position");
  Inputs of_layers(errors, "errors", static_cast<py::ssize_t>(detector.layers.size()));
  const auto rows = of_layers.read_rows<PositionErrors>();
  Columns<ClusterRow> found;
  {
    py::gil_scoped_release release;
    found = clusters_of_positions(detector, digis, rows);
  }
  return to_dict(std::move(found));
}

// One view of each layer after the other.
std::vector<PlaneErrors> plane_errors(const py::dict& table, py::ssize_t planes) {
  Inputs in(table, "planes", planes);
  auto found = in.read_rows<PlaneErrors>();
  for (PlaneErrors& one : found) one.wave = strip_wave(one.pitch, one.cloud);
  return found;
}

ShareTable share_table(const Array<double>& paths, const Array<double>& numbers, const Array<double>& values,
                       py::ssize_t layers) {
  if (paths.size() < 1 || numbers.size() < 1) {
    throw std::invalid_argument("shares: expected at least one path and number");
  }
  return {column(paths, "paths"), column(numbers, "numbers"),
          column(values, "values", layers * paths.size() * numbers.size())};
}

ChipErrors chip_errors(const py::dict& numbers) {
  Settings in("chip", numbers);
  const ChipErrors errors{.ionization = in["ionization"],
                          .cut = in["cut"],
                          .diffusion = in["diffusion"],
                          .span = in["span"],
                          .time = in["time"],
                          .wide = in["wide"],
                          .line = in["line"],
                          .height_by_threshold = in["height_by_threshold"],
                          .noise = in["noise"],
                          .jitter = in["jitter"],
                          .rise = in["rise"],
                          .level = in["level"],
                          .gain_variance = in["gain_variance"],
                          .electrons_per_fC = in["electrons_per_fC"],
                          .slope = in["slope"],
                          .share_spread = in["share_spread"]};
  in.check();
  return errors;
}

Estimator estimator_of(const std::string& name) {
  if (name == "merged") return Estimator::merged;
  if (name == "centroid") return Estimator::centroid;
  if (name == "micro-tpc") return Estimator::micro_tpc;
  throw std::invalid_argument("estimator: got " + name + ", expected merged, centroid or micro-tpc");
}

py::dict with_times(const Detector& detector, const py::dict& table, const py::dict& timing,
                    const py::dict& delays, const py::dict& chip, const py::dict& planes,
                    const py::dict& shares, const std::string& estimator, std::int32_t missing, double edge,
                    const Array<std::int32_t>& masked, std::int32_t bridge, const Array<double>& gain,
                    double valley, double margin, bool timed, const Array<double>& slopes,
                    const Array<double>& paths) {
  Inputs in(table, "digis");
  const auto digis = in.read<DigiView>();
  const std::size_t n = detector.layers.size();
  const auto rows = static_cast<py::ssize_t>(n);
  const auto layers = Inputs(timing, "timing", rows).read_rows<LayerTiming>();
  const std::vector<PlaneErrors> by_plane = plane_errors(planes, 2 * rows);
  const Array<double> spreads = take<double>(delays, "spreads"), charges = take<double>(delays, "charges"),
                      delay = take<double>(delays, "delays"), share_paths = take<double>(shares, "paths"),
                      numbers = take<double>(shares, "numbers"), values = take<double>(shares, "values"),
                      charges_apart = take<double>(shares, "charges_apart"),
                      times_apart = take<double>(shares, "times_apart"),
                      log_numbers = take<double>(shares, "log_numbers");
  const py::ssize_t points = n == 0 ? 2 : charges.size() / (2 * rows);
  if (points < 2 || spreads.size() < 1) throw std::invalid_argument("delays: expected charges and times");
  const ChargeTimeModel model{
      .layers = layers,
      .delays = {column(spreads, "spreads"), column(charges, "charges", 2 * rows * points),
                 column(delay, "delays", 2 * rows * spreads.size() * points),
                 static_cast<std::size_t>(points)},
      .errors = {chip_errors(chip), by_plane, share_table(share_paths, numbers, values, rows),
                 column(charges_apart, "charges_apart", rows), column(times_apart, "times_apart", rows),
                 column(log_numbers, "log_numbers", rows)},
      .estimator = estimator_of(estimator),
      .missing = missing,
      .mask = StripMask(detector, column(masked, "masked"), bridge),
      .gain = column(gain, "gain", gain.size() == 0 ? 0 : strips_of(detector)),
      .edge = edge,
      .valley = valley,
      .margin = margin,
      .timed = timed,
      .slopes = column(slopes, "slopes", slopes.size()),
      .paths = column(paths, "paths", slopes.size())};
  Columns<ClusterRow> found;
  {
    py::gil_scoped_release release;
    found = find_charge_time_clusters(detector, digis, model);
  }
  return to_dict(std::move(found));
}

// Variances, mm^2, of the clusters of one view and layer that are expected to have numbers of electrons.
py::array_t<double> expected_variances(const py::dict& chip, const py::dict& planes, const py::dict& shares,
                                       const std::string& estimator, bool of_track, int view,
                                       std::size_t layer, const Array<double>& slope,
                                       const Array<double>& path, const Array<double>& number) {
  const Array<double> share_paths = take<double>(shares, "paths"), numbers = take<double>(shares, "numbers"),
                      values = take<double>(shares, "values");
  const auto rows = take<double>(planes, "pitch").size();
  const std::vector<PlaneErrors> by_plane = plane_errors(planes, rows);
  const ChargeErrors errors{
      chip_errors(chip), by_plane, share_table(share_paths, numbers, values, rows / 2), {}, {}, {}};
  if ((view != 0 && view != 1) || layer >= static_cast<std::size_t>(rows / 2)) {
    throw std::invalid_argument("view, layer: expected one of the detector");
  }
  const auto slopes = column(slope, "slope"), paths = column(path, "path", slope.size()),
             electrons = column(number, "number", slope.size());
  std::vector<double> found(slopes.size());
  for (std::size_t i = 0; i < found.size(); ++i) {
    found[i] =
        errors.expected(estimator_of(estimator), of_track, view, layer, {slopes[i], paths[i]}, electrons[i]);
  }
  return to_numpy(std::move(found));
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
             py::arg("errors"), "Columns of clusters from columns of digis: readout without strips.");
  module.def("find_charge_time_clusters", &with_times, py::arg("detector"), py::arg("digis"), py::kw_only(),
             py::arg("timing"), py::arg("delays"), py::arg("chip"), py::arg("planes"), py::arg("shares"),
             py::arg("estimator"), py::arg("missing"), py::arg("edge"),
             py::arg_v("masked", Array<std::int32_t>(0), "..."), py::arg("bridge") = 0,
             py::arg_v("gain", Array<double>(0), "..."), py::arg("valley") = 0.0, py::arg("margin"),
             py::arg("timed") = true, py::arg_v("slopes", Array<double>(0), "..."),
             py::arg_v("paths", Array<double>(0), "..."),
             "Columns of clusters from columns of digis: charge centroid and line fit.");
  module.def("charge_variances", &expected_variances, py::kw_only(), py::arg("chip"), py::arg("planes"),
             py::arg("shares"), py::arg("estimator"), py::arg("of_track"), py::arg("view"), py::arg("layer"),
             py::arg("slope"), py::arg("path"), py::arg("number"),
             "Variances (mm^2) expected of clusters of numbers of electrons.");
  module.def(
      "size_errors", &errors_of_sizes, py::arg("extents"), py::arg("pitch"), py::arg("sizes"),
      "RMS of the position error (mm) of clusters of 1 to `sizes` strips for a sample of extents (mm).");
}

#include "reconstruction/fit/fit.hpp"

#include <pybind11/pybind11.h>

#include <algorithm>
#include <cmath>

#include "bindings/hits.hpp"
#include "bindings/interrupt.hpp"
#include "bindings/settings.hpp"
#include "detector/start_radius.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

FitSettings fit_settings(const py::dict& values) {
  Settings in("settings", values);
  const FitSettings settings{.max_iterations = in["max_iterations"],
                             .tolerance = in["tolerance"],
                             .errors_from_track = in["errors_from_track"],
                             .least_width = in["least_width"],
                             .delta_strips = in["delta_strips"],
                             .kinks = in["kinks"],
                             .outlier_pull = in["outlier_pull"],
                             .prior_sigma = in["prior_sigma"],
                             .beam = in["beam"],
                             .momentum = in["momentum"]};
  in.check();
  if (!(settings.momentum > 0 && settings.momentum < HUGE_VAL))
    throw std::invalid_argument("settings: momentum: expected a finite number above 0");
  return settings;
}

// Number of tracks whose hits stay in the processor's cache while they are fitted.
constexpr std::size_t block_of_tracks = 256;

py::dict run_fit(const Detector& detector, const Array<std::int64_t>& hit_offsets,
                 const py::dict& hit_columns, const Array<double>& mass_array,
                 const Array<double>& charge_array, const Array<double>& start_array,
                 const Array<double>& start_radius, const py::dict& setting_values, bool residuals,
                 bool states, bool densities) {
  const auto offsets = hit_offsets_of(hit_offsets);
  const auto n = offsets.size() - 1;
  const auto n_hits = static_cast<py::ssize_t>(offsets[n]);
  const auto mass = column(mass_array, "mass", static_cast<py::ssize_t>(n));
  const std::vector<double> charge = charges(charge_array, static_cast<py::ssize_t>(n));
  const bool seeded = start_array.ndim() == 2 && start_array.shape(0) > 0;
  if (seeded) matrix(start_array, "start", static_cast<py::ssize_t>(n), 5);
  const FitSettings settings = fit_settings(setting_values);
  const HitColumns columns(detector, hit_columns, n_hits, false);
  const auto side = columns.side();
  std::vector<Perigee> start;
  for (std::size_t i = 0; seeded && i < n; ++i) start.push_back(from_bes3(start_array.data() + 5 * i));
  const StartRadii begins(detector, n, start_radii(start_radius, static_cast<py::ssize_t>(n)));
  residuals = residuals || states;
  const std::size_t slabs = detector.slabs.size();
  Columns<FitRow> of_track;
  Columns<HitRow> of_hit;
  Columns<LastIteration> last;
  Columns<Measured> measured;
  Columns<KinkRow> kinks;
  Columns<DensityRow> density;
  of_track.reserve(n);
  of_hit.reserve(residuals ? static_cast<std::size_t>(n_hits) : 0);
  last.reserve(states ? n : 0);
  measured.reserve(states ? static_cast<std::size_t>(n_hits) : 0);
  kinks.reserve(states ? n * slabs : 0);
  density.reserve(densities ? n : 0);
  const auto fit = kernels().fit;
  {
    py::gil_scoped_release release;
    std::vector<Hit> hits;
    std::vector<FitRow> track_rows;
    std::vector<HitRow> hit_rows;
    std::vector<LastIteration> last_rows;
    std::vector<Measured> measured_rows;
    std::vector<KinkRow> kink_rows;
    std::vector<DensityRow> density_rows;
    for (std::size_t begin = 0, tracks = 0; begin < n && !interrupted(); begin += tracks) {
      tracks = begins.alike(begin, std::min(begin + block_of_tracks, n));
      const auto first = static_cast<std::size_t>(offsets[begin]),
                 count = static_cast<std::size_t>(offsets[begin + tracks]) - first;
      if (!columns.take(offsets.subspan(begin, tracks + 1), hits)) columns.check(offsets);
      track_rows.resize(tracks);
      hit_rows.resize(residuals ? count : 0);
      last_rows.resize(states ? tracks : 0);
      measured_rows.resize(states ? count : 0);
      kink_rows.resize(states ? tracks * slabs : 0);
      density_rows.resize(densities ? tracks : 0);
      const FitInput input{
          offsets.subspan(begin, tracks + 1),
          hits,
          side.subspan(first, count),
          mass.subspan(begin, tracks),
          std::span<const double>(charge).subspan(begin, tracks),
          seeded ? std::span<const Perigee>(start).subspan(begin, tracks) : std::span<const Perigee>(),
          interrupted};
      fit(begins.of(begin), input, settings,
          {track_rows.data(), residuals ? hit_rows.data() : nullptr, states ? last_rows.data() : nullptr,
           states ? measured_rows.data() : nullptr, states ? kink_rows.data() : nullptr,
           densities ? density_rows.data() : nullptr});
      of_track.append(track_rows);
      of_hit.append(hit_rows);
      last.append(last_rows);
      measured.append(measured_rows);
      kinks.append(kink_rows);
      density.append(density_rows);
    }
  }
  throw_if_interrupted();
  py::dict out = to_dict(std::move(of_track));
  if (residuals) add_columns(std::move(of_hit), out);
  if (densities) add_columns(std::move(density), out);
  if (!states) return out;
  add_columns(std::move(last), out);
  add_columns(std::move(measured), out);
  add_columns(std::move(kinks), out);
  return out;
}

}  // namespace

void bind_fit(py::module_& module) {
  module.attr("MOST_ERROR") = most_error;
  module.def("fit", &run_fit, py::arg("detector"), py::kw_only(), py::arg("hit_offsets"), py::arg("hits"),
             py::arg("mass"), py::arg_v("charge", Array<double>(0), "..."), py::arg("start"),
             py::arg_v("start_radius", Array<double>(0), "..."), py::arg("settings"), py::arg("residuals"),
             py::arg("states") = false, py::arg("densities") = false,
             "Fit one track per row of hit_offsets: columns of the tracks and, if requested, of the "
             "residuals of the hits and of the last iteration, from which states along the tracks are made, "
             "and of the densities of the "
             "momenta of electrons.");
}

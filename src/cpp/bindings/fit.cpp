#include "reconstruction/fit/fit.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>

#include "bindings/arrays.hpp"
#include "bindings/hits.hpp"
#include "kernels/kernels.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// The parts of the result that are requested besides the tracks.
struct Wanted {
  bool residuals, states;
};

// Columns of the result, filled block by block.
class Output {
 public:
  Output(std::size_t tracks, std::size_t hits, std::size_t slabs, const Wanted& wanted)
      : wanted_(wanted),
        helix_(tracks, {5}),
        covariance_(tracks, {5, 5}),
        chi2_(tracks),
        clusters_(tracks),
        wires_(tracks),
        outliers_(tracks),
        ndf_(tracks),
        iterations_(tracks),
        status_(tracks),
        residual_(wanted.residuals ? hits : 0),
        error_(wanted.residuals ? hits : 0),
        side_(wanted.residuals ? hits : 0),
        used_(wanted.residuals ? hits : 0),
        reference_(wanted.states ? tracks : 0, {5}),
        prior_(wanted.states ? tracks : 0, {25}),
        kinks_(wanted.states ? tracks * slabs : 0, {2}),
        value_(wanted.states ? hits : 0),
        variance_(wanted.states ? hits : 0) {}

  void append(const FitRow& row) {
    helix_.append(row.helix);
    covariance_.append(row.covariance);
    chi2_.append(row.chi2);
    clusters_.append(row.clusters);
    wires_.append(row.wires);
    outliers_.append(row.outliers);
    ndf_.append(row.clusters + row.wires - 5);
    iterations_.append(row.iterations);
    status_.append(static_cast<std::int8_t>(row.status));
  }
  void append(const HitRow& row) {
    residual_.append(row.residual);
    error_.append(row.error);
    side_.append(row.side);
    used_.append(row.used);
  }
  void append(const LastIteration& last) {
    reference_.append(last.reference);
    prior_.append(last.prior);
  }
  void append(const KinkRow& kink) { kinks_.append(kink); }
  void append(const Measured& measured) {
    value_.append(measured.value);
    variance_.append(measured.variance);
  }

  py::dict columns() const {
    py::dict out;
    out["helix"] = helix_.array();
    out["cov"] = covariance_.array();
    out["chi2"] = chi2_.array();
    out["ndf"] = ndf_.array();
    out["n_clusters"] = clusters_.array();
    out["n_wires"] = wires_.array();
    out["n_outliers"] = outliers_.array();
    out["iterations"] = iterations_.array();
    out["status"] = status_.array();
    if (!wanted_.residuals) return out;
    out["residual"] = residual_.array();
    out["err"] = error_.array();
    out["side"] = side_.array();
    out["used"] = used_.array();
    if (!wanted_.states) return out;
    out["reference"] = reference_.array();
    out["prior"] = prior_.array();
    out["kinks"] = kinks_.array();
    out["used_value"] = value_.array();
    out["used_variance"] = variance_.array();
    return out;
  }

 private:
  Wanted wanted_;
  Filled<double> helix_, covariance_, chi2_;
  Filled<std::int32_t> clusters_, wires_, outliers_, ndf_, iterations_;
  Filled<std::int8_t> status_;
  Filled<double> residual_, error_;
  Filled<std::int8_t> side_;
  Filled<std::uint8_t> used_;
  Filled<double> reference_, prior_, kinks_, value_, variance_;
};

// The rows of one block of tracks.
class Rows {
 public:
  FitOutput room(std::size_t tracks, std::size_t hits, std::size_t slabs, const Wanted& wanted) {
    tracks_.resize(tracks);
    hits_.resize(wanted.residuals ? hits : 0);
    last_.resize(wanted.states ? tracks : 0);
    measured_.resize(wanted.states ? hits : 0);
    kinks_.resize(wanted.states ? tracks * slabs : 0);
    return {tracks_.data(), wanted.residuals ? hits_.data() : nullptr, wanted.states ? last_.data() : nullptr,
            wanted.states ? measured_.data() : nullptr, wanted.states ? kinks_.data() : nullptr};
  }
  void append_to(Output& out) const {
    for (const FitRow& row : tracks_) out.append(row);
    for (const HitRow& row : hits_) out.append(row);
    for (const LastIteration& row : last_) out.append(row);
    for (const Measured& row : measured_) out.append(row);
    for (const KinkRow& row : kinks_) out.append(row);
  }

 private:
  std::vector<FitRow> tracks_;
  std::vector<HitRow> hits_;
  std::vector<LastIteration> last_;
  std::vector<Measured> measured_;
  std::vector<KinkRow> kinks_;
};

// Number of tracks whose hits stay in the processor's cache while they are fitted.
constexpr std::size_t block_of_tracks = 256;

py::dict run(const Detector& detector, const Array<std::int64_t>& hit_offsets, const py::dict& hit_columns,
             const Array<double>& mass_array, const Array<double>& start_array, const FitSettings& settings,
             bool residuals, bool states) {
  const auto offsets = hit_offsets_of(hit_offsets);
  const auto n = offsets.size() - 1;
  const auto n_hits = static_cast<py::ssize_t>(offsets[n]);
  const auto mass = column(mass_array, "mass", static_cast<py::ssize_t>(n));
  const bool seeded = start_array.ndim() == 2 && start_array.shape(0) > 0;
  if (seeded) matrix(start_array, "start", static_cast<py::ssize_t>(n), 5);
  const HitColumns columns(detector, hit_columns, n_hits);
  columns.check_order(offsets);
  const auto side = columns.side();
  std::vector<Perigee> start;
  for (std::size_t i = 0; seeded && i < n; ++i) start.push_back(from_bes3(start_array.data() + 5 * i));
  const Wanted wanted{residuals || states, states};
  const std::size_t slabs = detector.slabs.size();
  Output out(n, static_cast<std::size_t>(n_hits), slabs, wanted);
  const auto fit = kernels().fit;
  {
    py::gil_scoped_release release;
    std::vector<Hit> hits;
    Rows rows;
    for (std::size_t begin = 0; begin < n; begin += block_of_tracks) {
      const std::size_t tracks = std::min(block_of_tracks, n - begin);
      const auto first = static_cast<std::size_t>(offsets[begin]),
                 last = static_cast<std::size_t>(offsets[begin + tracks]);
      columns.take(first, last - first, hits);
      const FitInput input{
          offsets.subspan(begin, tracks + 1), hits, side.subspan(first, last - first),
          mass.subspan(begin, tracks),
          seeded ? std::span<const Perigee>(start).subspan(begin, tracks) : std::span<const Perigee>()};
      fit(detector, input, settings, rows.room(tracks, last - first, slabs, wanted));
      rows.append_to(out);
    }
  }
  return out.columns();
}

}  // namespace

void bind_fit(py::module_& module) {
  py::class_<FitSettings>(module, "FitSettings",
                          "Settings of the fit; the values live in cgemit.fit.FitSettings.")
      .def(py::init([](int max_iterations, double tolerance, bool errors_from_track, double least_width,
                       double delta_strips, bool kinks, double outlier_pull,
                       const std::array<double, 5>& prior_sigma) {
             return FitSettings{max_iterations, tolerance, errors_from_track, least_width,
                                delta_strips,   kinks,     outlier_pull,      prior_sigma};
           }),
           py::kw_only(), py::arg("max_iterations"), py::arg("tolerance"), py::arg("errors_from_track"),
           py::arg("least_width"), py::arg("delta_strips"), py::arg("kinks"), py::arg("outlier_pull"),
           py::arg("prior_sigma"));
  module.def("fit", &run, py::arg("detector"), py::kw_only(), py::arg("hit_offsets"), py::arg("hits"),
             py::arg("mass"), py::arg("start"), py::arg("settings"), py::arg("residuals"),
             py::arg("states") = false,
             "Fit one track per row of hit_offsets: columns of the tracks and, if requested, of the "
             "residuals of the hits and of the last iteration, from which states along the tracks are made.");
}

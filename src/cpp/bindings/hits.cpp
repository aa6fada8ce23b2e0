#include "bindings/hits.hpp"

#include <algorithm>
#include <cmath>

#include "common/angles.hpp"
#include "reconstruction/fit/collect_hits.hpp"

namespace cgemit::bindings {

HitColumns::HitColumns(const Detector& detector, const py::dict& columns, py::ssize_t n, bool check)
    : rules_(detector), in_(columns, "hits", n), hits_(in_.read<HitView>()) {
  if (hits_.side.size() != hits_.kind.size()) {
    no_sides_.resize(hits_.kind.size());
    hits_.side = no_sides_;
  }
  if (check) check_hits(rules_, hits_);
}

void HitColumns::check(std::span<const std::int64_t> offsets) const {
  check_hits(rules_, hits_);
  Problems problems;
  for (std::size_t track = 0; track + 1 < offsets.size(); ++track) {
    int last = -1;
    for (auto i = static_cast<std::size_t>(offsets[track]); i < static_cast<std::size_t>(offsets[track + 1]);
         ++i) {
      const int surface = rules_.surface(hits_.kind[i], hits_.layer[i]);
      if (surface < last) {
        problems.add("track " + std::to_string(track) + ": hit " + std::to_string(i) +
                     " lies inside the one before; expected hits from the beam line outward");
        break;
      }
      last = surface;
    }
  }
  problems.raise("hits");
}

std::vector<UsedHit> used_hits(const py::dict& columns, py::ssize_t n) {
  auto hits = Inputs(columns, "hits", n).read_rows<UsedHit>();
  for (const UsedHit& hit : hits)
    if (hit.used != 0 && !(std::isfinite(hit.value) && hit.variance > 0 && hit.variance < HUGE_VAL))
      throw std::invalid_argument("used_value, used_variance: expected finite numbers, variances above 0");
  return hits;
}

std::span<const std::int64_t> hit_offsets_of(const Array<std::int64_t>& array) {
  const auto offsets = column(array, "hit_offsets");
  if (offsets.empty() || offsets[0] != 0)
    throw std::invalid_argument("hit_offsets: expected to begin with 0");
  for (std::size_t i = 0; i + 1 < offsets.size(); ++i) {
    if (offsets[i] > offsets[i + 1]) throw std::invalid_argument("hit_offsets: expected to increase");
  }
  return offsets;
}

std::span<const double> start_radii(const Array<double>& array, py::ssize_t n) {
  const auto radii = column(array, "start_radius", array.size() == 0 ? 0 : n);
  if (!std::ranges::all_of(radii, [](double radius) { return std::isfinite(radius); }))
    throw std::invalid_argument("start_radius: expected finite numbers");
  return radii;
}

std::vector<double> charges(const Array<double>& array, py::ssize_t n) {
  if (array.size() == 0) return std::vector<double>(static_cast<std::size_t>(n), 1.0);
  const auto given = column(array, "charge", n);
  if (!std::ranges::all_of(given, [](double charge) { return charge != 0 && std::isfinite(charge); }))
    throw std::invalid_argument("charge: expected finite numbers other than 0");
  std::vector<double> found;
  for (const double charge : given) found.push_back(std::abs(charge));
  return found;
}

Perigee from_bes3(const double* row) {
  return {row[0], wrap_angle(row[1] + 0.5 * pi), row[2], row[3], row[4]};
}

namespace {

py::dict collect(const Detector& detector, const py::dict& candidates, const py::dict& candidate_hits,
                 const py::dict& clusters, const py::dict& wire_hits) {
  Inputs candidate(candidates, "candidates"), hit(candidate_hits, "candidate_hits"),
      cluster(clusters, "clusters"), wire(wire_hits, "wire_hits");
  const CandidateInput chosen{.event = candidate.get<std::int64_t>("event"),
                              .mass = candidate.get<double>("mass"),
                              .hit_event = hit.get<std::int64_t>("event"),
                              .candidate = hit.get<std::int64_t>("candidate"),
                              .hit = hit.get<std::int64_t>("hit"),
                              .view = hit.get<std::int8_t>("view")};
  const auto of_clusters = cluster.read<ClusterInput>();
  const auto of_wires = wire.read<WireInput>();
  CollectedHits hits;
  {
    py::gil_scoped_release release;
    hits = collect_hits(detector, chosen, of_clusters, of_wires);
  }
  return to_dict(std::move(hits));
}

py::tuple problems(const Detector& detector, const py::dict& hits) {
  const HitColumns columns(detector, hits, -1, false);
  const HitProblems found = columns.problems();
  py::list listed;
  for (const HitProblem& one : found.listed)
    listed.append(py::make_tuple(one.hit, one.name, one.got, one.expected));
  return py::make_tuple(listed, found.count);
}

}  // namespace

}  // namespace cgemit::bindings

void bind_hits(pybind11::module_& module) {
  namespace py = pybind11;
  module.def("hit_problems", &cgemit::bindings::problems, py::arg("detector"), py::arg("hits"),
             "What is wrong with measurements: the first few dozen problems, and their number.");
  module.def("collect_hits", &cgemit::bindings::collect, py::arg("detector"), py::kw_only(),
             py::arg("candidates"), py::arg("candidate_hits"), py::arg("clusters"), py::arg("wire_hits"),
             "Measurements of track candidates as flat columns, ordered from the beam line outward.");
}

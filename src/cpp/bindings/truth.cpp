#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/inputs.hpp"
#include "truth/owners.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

CrossingRows crossings_of(Inputs& in) {
  return {numbered(in), in.get<std::int32_t>("daughter"), in.get<std::int8_t>("half_turn")};
}

// Links count rows below `size`; those below `least` are no rows.
Links links(Inputs& in, const char* name, std::size_t size, std::int64_t least = -1) {
  const Links found = in.get<std::int64_t>(name);
  for (std::size_t i = 0; i < found.size(); ++i)
    if (found[i] < least || found[i] >= static_cast<std::int64_t>(size))
      throw std::invalid_argument(std::string(name) + " " + std::to_string(i) + ": got " +
                                  std::to_string(found[i]) + ", expected at most " + std::to_string(size) +
                                  " rows");
  return found;
}

py::dict matched(const py::dict& particles, const py::dict& truths, const py::dict& wire_truths,
                 const py::dict& clusters, const py::dict& wire_hits, const py::dict& candidate_hits,
                 std::size_t candidates) {
  Inputs of_particles(particles, "event"), of_truths(truths, "event"), of_crossings(wire_truths, "event"),
      of_clusters(clusters, "event"), of_wires(wire_hits, "event"), of_hits(candidate_hits, "event");
  const CrossingRows in_gaps = crossings_of(of_truths), in_cells = crossings_of(of_crossings);
  const MatchInput input{.particles = numbered(of_particles),
                         .truths = in_gaps,
                         .wire_truths = in_cells,
                         .cluster_truth = links(of_clusters, "truth", in_gaps.event.size()),
                         .wire_truth = links(of_wires, "wire_truth", in_cells.event.size()),
                         .cluster_view = of_clusters.get<std::int8_t>("view"),
                         .x_cluster = of_clusters.get<std::int64_t>("x_cluster"),
                         .candidate = links(of_hits, "candidate", candidates, 0),
                         .row = of_hits.get<std::int64_t>("row"),
                         .view = of_hits.get<std::int8_t>("view"),
                         .candidates = candidates};
  check_rows(input);
  MatchOutput found;
  {
    py::gil_scoped_release release;
    found = match_hits(input);
  }
  py::dict out;
  out["particle"] = to_numpy(std::move(found.particle));
  out["own"] = to_numpy(std::move(found.own));
  out["hits"] = to_numpy(std::move(found.hits));
  out["found"] = to_numpy(std::move(found.found));
  out["left"] = to_numpy(std::move(found.left));
  out["of_daughters"] = to_numpy(std::move(found.of_daughters));
  out["of_loops"] = to_numpy(std::move(found.of_loops));
  out["half_turn"] = to_numpy(std::move(found.half_turn));
  out["crossings"] = to_numpy(std::move(found.crossings));
  out["crossings_left"] = to_numpy(std::move(found.crossings_left));
  return out;
}

py::dict assigned(const py::dict& particles, const py::dict& truths, const py::dict& wire_truths,
                  const py::dict& clusters, const py::dict& wire_hits, const Array<std::int64_t>& candidates,
                  const Array<std::int64_t>& rows) {
  Inputs of_particles(particles, "event"), of_truths(truths, "event"), of_crossings(wire_truths, "event"),
      of_clusters(clusters, "event"), of_wires(wire_hits, "event");
  const CrossingRows in_gaps = crossings_of(of_truths), in_cells = crossings_of(of_crossings);
  const AssignInput input{.particles = numbered(of_particles),
                          .truths = in_gaps,
                          .wire_truths = in_cells,
                          .candidates = column(candidates, "candidates", py::len(particles["event"])),
                          .clusters = column(rows, "rows"),
                          .cluster_truth = links(of_clusters, "truth", in_gaps.event.size()),
                          .wire_truth = links(of_wires, "wire_truth", in_cells.event.size()),
                          .cluster_view = of_clusters.get<std::int8_t>("view"),
                          .cluster_layer = of_clusters.get<std::int32_t>("layer"),
                          .wire_layer = of_wires.get<std::int32_t>("layer")};
  HitsOfParticles found;
  {
    py::gil_scoped_release release;
    found = assign_hits(input);
  }
  py::dict out;
  out["candidate"] = to_numpy(std::move(found.candidate));
  out["view"] = to_numpy(std::move(found.view));
  out["row"] = to_numpy(std::move(found.row));
  return out;
}

}  // namespace

void bind_truth(py::module_& module) {
  module.def(
      "match_hits", &matched, py::kw_only(), py::arg("particles"), py::arg("truths"), py::arg("wire_truths"),
      py::arg("clusters"), py::arg("wire_hits"), py::arg("candidate_hits"), py::arg("candidates"),
      "Of each candidate the row of its particle and numbers of hits; of each particle the hits it left.");
  module.def("assign_hits", &assigned, py::kw_only(), py::arg("particles"), py::arg("truths"),
             py::arg("wire_truths"), py::arg("clusters"), py::arg("wire_hits"), py::arg("candidates"),
             py::arg("rows"), "Hits of the candidate of each particle, from the beam line outward.");
}

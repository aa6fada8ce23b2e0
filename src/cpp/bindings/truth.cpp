#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/fields.hpp"
#include "truth/owners.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

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
  Inputs of_particles(particles, "particles"), of_truths(truths, "truths"),
      of_crossings(wire_truths, "wire_truths"), of_clusters(clusters, "clusters"),
      of_wires(wire_hits, "wire_hits"), of_hits(candidate_hits, "candidate_hits");
  const CrossingRows in_gaps = of_truths.read<CrossingRows>(), in_cells = of_crossings.read<CrossingRows>();
  const MatchInput input{.particles = of_particles.read<NumberedRows>(),
                         .truths = in_gaps,
                         .wire_truths = in_cells,
                         .cluster_truth = links(of_clusters, "truth", in_gaps.event.size()),
                         .wire_truth = links(of_wires, "wire_truth", in_cells.event.size()),
                         .cluster_view = of_clusters.get<std::int8_t>("view"),
                         .x_cluster = of_clusters.get<std::int64_t>("x_cluster"),
                         .candidate = links(of_hits, "candidate", candidates, 0),
                         .hit = of_hits.get<std::int64_t>("hit"),
                         .view = of_hits.get<std::int8_t>("view"),
                         .candidates = candidates};
  check_rows(input);
  MatchOutput found;
  {
    py::gil_scoped_release release;
    found = match_hits(input);
  }
  return to_dict(std::move(found));
}

py::dict assigned(const py::dict& particles, const py::dict& truths, const py::dict& wire_truths,
                  const py::dict& clusters, const py::dict& wire_hits, const Array<std::int64_t>& candidates,
                  const Array<std::int64_t>& rows) {
  Inputs of_particles(particles, "particles"), of_truths(truths, "truths"),
      of_crossings(wire_truths, "wire_truths"), of_clusters(clusters, "clusters"),
      of_wires(wire_hits, "wire_hits");
  const CrossingRows in_gaps = of_truths.read<CrossingRows>(), in_cells = of_crossings.read<CrossingRows>();
  const AssignInput input{.particles = of_particles.read<NumberedRows>(),
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
  return to_dict(std::move(found));
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

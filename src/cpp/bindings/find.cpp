#include "reconstruction/find/find.hpp"

#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "bindings/fields.hpp"
#include "bindings/hits.hpp"
#include "bindings/interrupt.hpp"
#include "bindings/part.hpp"
#include "bindings/settings.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

FindSettings find_settings(const py::dict& values) {
  Settings in("settings", values);
  const FindSettings settings{.segments = in["segments"],
                              .chamber = in["chamber"],
                              .mass = in["mass"],
                              .charge = in["charge"],
                              .efficiency = in["efficiency"],
                              .gate = in["gate"],
                              .branches = in["branches"],
                              .passes = in["passes"],
                              .holes_in_row = in["holes_in_row"],
                              .max_d = in["max_d"],
                              .max_z = in["max_z"],
                              .min_pt = in["min_pt"],
                              .least_axial = in["least_axial"],
                              .min_score = in["min_score"],
                              .max_seeds = in["max_seeds"],
                              .annealing = in["annealing"],
                              .least_width = in["least_width"],
                              .delta_strips = in["delta_strips"],
                              .momentum = in["momentum"]};
  in.check();
  Problems problems;
  const Part part(problems, "settings");
  part.within("mass", settings.mass, tiny, far);
  part.within("charge", settings.charge, tiny, far);
  part.within("efficiency", settings.efficiency, 0, 1);
  part.within("gate", settings.gate, tiny, far);
  part.within("max_d", settings.max_d, 0, far);
  part.within("max_z", settings.max_z, 0, far);
  part.within("min_pt", settings.min_pt, tiny, far);
  part.within("min_score", settings.min_score, -far, far);
  part.within("least_width", settings.least_width, 0, far);
  part.within("delta_strips", settings.delta_strips, 0, 1);
  part.within("momentum", settings.momentum, 0, far);
  problems.raise("find_tracks");
  return settings;
}

py::dict run_find(const Detector& detector, const Array<std::int64_t>& event_offsets,
                  const py::dict& hit_columns, const py::dict& setting_values, const py::dict& pair_table) {
  const FindSettings settings = find_settings(setting_values);
  const auto offsets = hit_offsets_of(event_offsets);
  const HitColumns columns(detector, hit_columns, static_cast<py::ssize_t>(offsets.back()));
  PairScores pairs;
  if (!pair_table.empty()) {
    Inputs in(pair_table, "pairs");
    pairs = PairScores(in.get<std::int64_t>("x"), in.get<std::int64_t>("v"), in.get<double>("score"));
  }
  FindOutput found;
  {
    py::gil_scoped_release release;
    std::vector<Hit> hits;
    columns.take(0, static_cast<std::size_t>(offsets.back()), hits);
    found = find_tracks(detector, {offsets, hits, std::move(pairs), interrupted}, settings);
  }
  throw_if_interrupted();
  return to_dict(std::move(found));
}

}  // namespace

void bind_find(py::module_& module) {
  module.def("circle_layers", &circle_layers, py::arg("detector"), py::kw_only(), py::arg("least_axial"),
             "Return how many layers a circle from the beam line needs where no cells fire by chance.");
  module.def(
      "segment_pairs",
      [](const Detector& detector) {
        py::list found;
        for (const auto& [inner, outer] : layer_pairs(detector, between_two))
          found.append(py::make_tuple(inner, outer));
        return found;
      },
      py::arg("detector"), "Return the pairs of layers of which segments are made.");
  module.def("view_layers", &view_layers, py::kw_only(), py::arg("layers"), py::arg("least_axial"),
             "Return how many layers of one stereo sign a circle needs among so many, without axial wires.");
  module.def(
      "find_tracks", &run_find, py::arg("detector"), py::kw_only(), py::arg("event_offsets"), py::arg("hits"),
      py::arg("settings"), py::arg("pairs") = py::dict(),
      "Tracks of each event: event, offsets of their hits, numbers of the hits, score; and of each event "
      "how many seeds were followed and which limits cut the search off.");
}

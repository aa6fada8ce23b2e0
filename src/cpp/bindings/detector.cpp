#include "detector/detector.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <tuple>
#include <utility>
#include <variant>

#include "bindings/chamber.hpp"
#include "bindings/fields.hpp"
#include "bindings/gap.hpp"
#include "bindings/matter.hpp"
#include "common/angles.hpp"
#include "common/problems.hpp"
#include "detector/start_radius.hpp"
#include "kalman/group.hpp"
#include "matter/loss.hpp"
#include "matter/scattering.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// A table of errors, (tanl, p_T).
MomentumErrors momentum_errors(const py::dict& table) {
  const auto copied = [&](const char* name, py::ssize_t size) {
    const auto values = take<double>(table, name);
    const auto all = column(values, name, size);
    return std::vector<double>(all.begin(), all.end());
  };
  MomentumErrors errors(usual_momentum_error);
  errors.log_first = table["log_first"].cast<double>();
  errors.step = table["step"].cast<double>();
  errors.tanl = copied("tanl", -1);
  errors.hits = copied("hits", -1);
  errors.scattered = copied("scattered", static_cast<py::ssize_t>(errors.hits.size()));
  if (errors.tanl.size() < 2 || errors.hits.size() % errors.tanl.size() != 0 ||
      errors.hits.size() < 2 * errors.tanl.size() || !(errors.step > 0))
    throw std::invalid_argument("errors: expected a grid of two or more momenta and angles");
  return errors;
}

// Holes with the slab that has them.
struct HoleRow {
  std::int32_t slab;
  Holes holes;

  static constexpr auto columns() {
    return std::tuple(Column("slab", &HoleRow::slab), Column("", &HoleRow::holes));
  }
};

// Slabs with their components, rows first[i] to first[i + 1] of slab i, and with the holes of those that are
// parts of GEM foils. `lattice` also has the RNG counter's `place` of each slab; it may be empty.
std::vector<Slab> read_slabs(const py::dict& columns, const Array<double>& log_terms,
                             const py::dict& composition, const py::dict& lattice, Problems& problems) {
  auto slabs = Inputs(columns, "slabs").read_rows<Slab>(problems);
  const py::ssize_t n = problems.empty() ? static_cast<py::ssize_t>(slabs.size()) : -1;
  Inputs of_components(composition, "composition", n < 0 ? -1 : n + 1), of_places(lattice, "lattice", n);
  const auto first = of_components.get<std::int32_t>("first", problems);
  const auto components = Inputs(composition, "composition").read_rows<Component>(problems);
  std::span<const std::uint32_t> places;
  std::vector<HoleRow> holes;
  if (!lattice.empty()) {
    places = of_places.get<std::uint32_t>("place", problems);
    holes = Inputs(lattice, "lattice").read_rows<HoleRow>(problems);
  }
  if (!problems.empty()) return slabs;
  const auto terms = matrix(log_terms, "log_terms", n, loss_points);
  if (first.front() != 0 || !std::ranges::is_sorted(first))
    throw std::invalid_argument("first: expected to begin with 0 and not to decrease");
  for (std::size_t i = 0; i < slabs.size(); ++i) {
    for (std::size_t k = 0; k < loss_points; ++k) slabs[i].table[k].log_term = terms[i * loss_points + k];
    for (std::int32_t k = first[i]; k < first[i + 1]; ++k)
      slabs[i].components.push_back(components.at(static_cast<std::size_t>(k)));
    slabs[i].place = places.empty() ? static_cast<std::uint32_t>(i) : places[i];
  }
  for (const HoleRow& row : holes) slabs.at(static_cast<std::size_t>(row.slab)).holes = row.holes;
  return slabs;
}

std::vector<MeasuringLayer> read_layers(const py::dict& columns, Problems& problems) {
  auto layers = Inputs(columns, "layers").read_rows<MeasuringLayer>(problems);
  for (MeasuringLayer& layer : layers) set_moved(layer.placement);
  return layers;
}

void check(Problems& problems, double bz, const std::vector<Slab>& slabs,
           const std::vector<MeasuringLayer>& layers, std::size_t gaps) {
  constexpr double most_strips = 1e9;
  if (!std::isfinite(bz)) problems.add("bz: got " + to_text(bz) + ", expected a finite number");
  if (gaps != 0 && gaps != layers.size())
    problems.add("gaps: got " + std::to_string(gaps) + ", expected one for each of " +
                 std::to_string(layers.size()) + " layers");
  for (std::size_t i = 0; i < slabs.size(); ++i) {
    const Part part(problems, "slab", i);
    part.within("r_in", slabs[i].r_in, 0, far);
    part.within("r_out", slabs[i].r_out, slabs[i].r_in, far);
    part.within("radius", slabs[i].radius, 0, far);
    part.within("spread", slabs[i].spread, 0, far);
    part.within("z_min", slabs[i].ends.low, -HUGE_VAL, HUGE_VAL);
    part.within("z_max", slabs[i].ends.high, slabs[i].ends.low, HUGE_VAL);
    part.within("x0", slabs[i].x0, 0, far);
    part.within("xi", slabs[i].xi, 0, far);
    part.within("gap", slabs[i].gap, -1, static_cast<double>(layers.size()) - 1);
    part.within("filler", static_cast<double>(slabs[i].filler), 0, static_cast<double>(Filler::chamber_gas));
    for (const SlabPoint& point : slabs[i].table) part.within("log_terms", point.log_term, -far, far);
    for (const Component& one : slabs[i].components) {
      part.within("z", one.z, tiny, far);
      part.within("a", one.a, tiny, far);
      part.within("moles", one.moles, 0, far);
    }
  }
  for (std::size_t i = 0; i < layers.size(); ++i) {
    const Part part(problems, "layer", i);
    part.within("r_gap_in", layers[i].r_gap_in, tiny, far);
    part.within("r_gap_out", layers[i].r_gap_out, layers[i].r_gap_in, far);
    part.within("r_readout", layers[i].r_readout, tiny, far);
    part.within("z_min", layers[i].ends.low, -far, far);
    part.within("z_max", layers[i].ends.high, layers[i].ends.low + tiny, far);
    part.within("pitch_x", layers[i].pitch_x, tiny, far);
    part.within("pitch_v", layers[i].pitch_v, tiny, far);
    part.within("stereo", std::abs(layers[i].stereo), tiny, pi);
    part.within("offset_v", layers[i].offset_v, -far, far);
    part.within("dead_seam", layers[i].dead_seam, 0, far);
    part.within("dead_ends", layers[i].dead_ends, 0, far);
    part.within("lorentz_shift", layers[i].lorentz_shift, -far, far);
    part.within("z_scale", layers[i].z_scale, -0.5, 0.5);
    part.within("slope", layers[i].slope, 0, far);
    part.within("sheets", layers[i].sheets, 1, most_sheets);
    part.within("ladders", layers[i].ladders, 0, most_strips);
    part.within("ladder_gap", layers[i].ladder_gap, 0, far);
    part.within("ladder_first", layers[i].ladder_first, -far, far);
    part.within("strips_x", layers[i].strips_x, 1, most_strips);
    part.within("strips_v", layers[i].strips_v, 1, most_strips);
    for (const double phi : layers[i].phi_first) part.within("phi_first", phi, -far, far);
    for (const double shift : layers[i].placement.shift) part.within("placement_shift", shift, -far, far);
    for (const double one : layers[i].placement.turn) part.within("placement_turn", one, -1, 1);
  }
}

}  // namespace

void bind_detector(py::module_& module) {
  module.attr("LOSS_GRID_FIRST") = loss_grid_first;
  module.attr("LOSS_GRID_STEP") = loss_grid_step;
  module.attr("LOSS_POINTS") = loss_points;
  module.attr("ELECTRON_GRID_FIRST") = electron_grid_first;
  module.attr("ELECTRON_STEPS") = electron_steps;
  module.attr("ELECTRON_POINTS") = electron_points;
  module.attr("MOST_SHEETS") = most_sheets;
  py::class_<Chamber>(module, "Chamber",
                      "The wire layers of a drift chamber in place, for any number of detectors.")
      .def(py::init(&make_chamber), py::arg("wires"));
  py::class_<Detector>(module, "Detector",
                       "The detector as plain numbers, ordered from the beam line outward.")
      .def(py::init([](double bz, const py::dict& slabs, const Array<double>& log_terms,
                       const py::dict& composition, const py::dict& layer_columns,
                       const std::variant<Chamber, py::dict>& wires, Screening screening,
                       const py::dict& lattice, const py::list& gaps, const std::optional<FieldMap>& field,
                       bool simulated) {
             Problems problems;
             std::vector<Slab> made = read_slabs(slabs, log_terms, composition, lattice, problems);
             std::vector<MeasuringLayer> layers = read_layers(layer_columns, problems);
             const py::dict* columns = std::get_if<py::dict>(&wires);
             WireTable unplaced = columns != nullptr ? read_wires(*columns, problems) : WireTable();
             std::vector<GapMatter> matter = read_gaps(gaps, problems);
             problems.raise("detector");
             check(problems, bz, made, layers, matter.size());
             check(problems, unplaced);
             problems.raise("detector");
             Chamber chamber = columns != nullptr ? in_place(std::move(unplaced)) : std::get<Chamber>(wires);
             Detector detector =
                 make_detector(field ? *field : uniform_field(bz), std::move(made), std::move(layers),
                               std::move(chamber.layers), std::move(matter));
             prepare_scattering(detector, screening, simulated);
             prepare_loss(detector, CoreLoss::truncated, true, usual_momentum_error);
             return detector;
           }),
           py::kw_only(), py::arg("bz"), py::arg("slabs"), py::arg("log_terms"), py::arg("composition"),
           py::arg("layers"), py::arg("wires"), py::arg("screening"), py::arg("lattice") = py::dict(),
           py::arg("gaps") = py::list(), py::arg("field") = py::none(), py::arg("simulated") = true)
      .def("beginning_at", &beginning_at, py::arg("radius"),
           "The detector for the fit of particles that begin at a radius (mm): matter inside was not "
           "crossed, or "
           "twice if the radius is negative.")
      .def(
          "with_loss",
          [](Detector detector, CoreLoss loss, bool radiation, double momentum_error) {
            Problems problems;
            Part part(problems, "loss");
            part.within("momentum_error", momentum_error, 0, 1);
            problems.raise("detector");
            prepare_loss(detector, loss, radiation, momentum_error);
            return detector;
          },
          py::kw_only(), py::arg("loss"), py::arg("radiation"), py::arg("momentum_error"),
          "The detector with another energy loss that the fit subtracts, for a relative error of all "
          "momenta.")
      .def(
          "with_errors",
          [](Detector detector, const py::dict& errors) {
            detector.errors = momentum_errors(errors);
            return detector;
          },
          py::arg("errors"),
          "The detector with a table of relative errors of the momentum: `log_first` and `step` of "
          "ln(p_T/(GeV/c)), tan(lambda) (`tanl`), and (tanl, p_T) errors by hits over p_T (`hits`) and by "
          "scattering times beta (`scattered`).")
      .def(
          "with_shared_scattering",
          [](Detector detector, const Array<double>& parts, const Array<double>& variances,
             const Array<double>& hits, double p, double mass) {
            const auto n = static_cast<py::ssize_t>(detector.slabs.size());
            const auto columns = matrix(parts, "parts", n, 5);
            std::vector<std::array<double, 5>> rows(detector.slabs.size());
            for (std::size_t i = 0; i < rows.size(); ++i)
              std::ranges::copy(columns.subspan(5 * i, 5), rows[i].begin());
            std::array<double, 5> whole{}, measured{};
            std::ranges::copy(column(variances, "variances", 5), whole.begin());
            std::ranges::copy(column(hits, "hits", 5), measured.begin());
            share_scattering(detector, rows, whole, measured, particle(p, mass, 1.0));
            return detector;
          },
          py::kw_only(), py::arg("parts"), py::arg("variances"), py::arg("hits"), py::arg("p"),
          py::arg("mass"),
          "The detector with the matter that acts with each slab, from the variances of the parameters of "
          "one track, the parts of each slab's scatters in them, and those of its hits.")
      .def(
          "with_shared_loss",
          [](Detector detector, const Array<double>& variances, double p, double mass, double tanl) {
            const auto n = static_cast<py::ssize_t>(detector.slabs.size());
            share_loss(detector, column(variances, "variances", n), particle(p, mass, 1.0), tanl);
            return detector;
          },
          py::arg("variances"), py::kw_only(), py::arg("p"), py::arg("mass"), py::arg("tanl") = 0.0,
          "The detector with the share of a loss in each slab that the fit takes for another kappa, from the "
          "variances of kappa, ((GeV/c)^-1)^2, by the stragglings of a particle from the origin.")
      .def(
          "in_field",
          [](Detector detector, double bz) {
            if (!(std::isfinite(bz) && bz != 0))
              throw std::invalid_argument("bz: expected a finite number other than 0");
            if (detector.field.is_uniform() || is_straight(detector.bz)) {
              detector.field = uniform_field(bz);
            } else {
              for (double& one : detector.field.coefficients) one *= bz / detector.bz;
              detector.field.bz = bz;
            }
            detector.bz = bz;
            return detector;
          },
          py::arg("bz"),
          "The detector in its own field scaled to bz at the origin, T; in a uniform one if that "
          "is nearly 0.")
      .def_readonly("bz", &Detector::bz)
      .def_readonly("field", &Detector::field)
      .def_property_readonly("by_hits",
                             [](const Detector& d) {
                               std::vector<double> by_hits;
                               for (const Slab& slab : d.slabs) by_hits.push_back(slab.by_hits);
                               return to_numpy(std::move(by_hits));
                             })
      .def_property_readonly("acting",
                             [](const Detector& d) {
                               std::vector<double> acting;
                               for (const Slab& slab : d.slabs) acting.push_back(slab.acting);
                               return to_numpy(std::move(acting));
                             })
      .def(
          "untuned",
          [](Detector detector) {
            const double last = last_measurement(detector);
            double before = 0;
            for (const Slab& slab : detector.slabs)
              if (slab.radius < last) before += slab.chi_c2;
            for (Slab& slab : detector.slabs) {
              slab.acting = slab.radius < last ? before : HUGE_VAL;
              slab.by_hits = 0;
              set_unseen(slab, slab.radius < last ? 1 : 0);
            }
            return detector;
          },
          "The detector in which all matter before the last measurement acts alike.")
      .def_property_readonly("unseen",
                             [](const Detector& d) {
                               std::vector<double> unseen;
                               for (const Slab& slab : d.slabs) unseen.push_back(slab.unseen);
                               return to_numpy(std::move(unseen));
                             })
      .def_property_readonly("last_measurement", &last_measurement)
      .def_property_readonly("has_equal_ends", &has_equal_ends)
      .def_property_readonly("slope_through_most", &slope_through_most)
      .def_property_readonly("n_slabs", [](const Detector& d) { return d.slabs.size(); })
      .def_property_readonly("n_layers", [](const Detector& d) { return d.layers.size(); })
      .def_property_readonly("n_wire_layers", [](const Detector& d) { return d.wires.size(); });
}

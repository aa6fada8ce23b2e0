#include "bindings/matter.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>

#include <cstdint>
#include <tuple>
#include <utility>

#include "bindings/fields.hpp"
#include "matter/decay_table.hpp"
#include "matter/loss.hpp"
#include "matter/scattering.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// Modes and products with the rows of their species and modes.
struct ModeRow {
  std::int32_t species;
  DecayMode mode;

  static constexpr auto columns() {
    return std::tuple(Column("species", &ModeRow::species), Column("", &ModeRow::mode));
  }
};
struct ProductRow {
  std::int32_t mode;
  DecayProduct product;

  static constexpr auto columns() {
    return std::tuple(Column("mode", &ProductRow::mode), Column("", &ProductRow::product));
  }
};

DecayTable make_decays(const py::dict& species, const py::dict& modes, const py::dict& products) {
  Problems problems;
  DecayTable table{.species = Inputs(species, "species").read_rows<UnstableSpecies>(problems)};
  auto of_species = Inputs(modes, "modes").read_rows<ModeRow>(problems);
  const auto of_modes = Inputs(products, "products").read_rows<ProductRow>(problems);
  problems.raise("decays");
  for (const ProductRow& row : of_modes)
    of_species.at(static_cast<std::size_t>(row.mode)).mode.products.push_back(row.product);
  for (ModeRow& row : of_species)
    table.species.at(static_cast<std::size_t>(row.species)).modes.push_back(std::move(row.mode));
  for (const UnstableSpecies& one : table.species) check(one);
  return table;
}

}  // namespace

void bind_models(py::module_& module) {
  py::native_enum<Screening>(module, "Screening", "enum.IntEnum",
                             "Screening of nuclei by their electrons in multiple scattering.")
      .value("wentzel", Screening::wentzel)
      .value("moliere", Screening::moliere)
      .finalize();
  py::native_enum<CoreLoss>(module, "CoreLoss", "enum.IntEnum",
                            "Energy loss subtracted by the fit, with its variance.")
      .value("truncated", CoreLoss::truncated)
      .value("mean", CoreLoss::mean)
      .value("most_probable", CoreLoss::most_probable)
      .finalize();
  py::native_enum<DecaySpectrum>(module, "DecaySpectrum", "enum.IntEnum",
                                 "Distribution of the products' momenta in the rest frame.")
      .value("phase_space", DecaySpectrum::phase_space)
      .value("semileptonic", DecaySpectrum::semileptonic)
      .value("michel", DecaySpectrum::michel)
      .finalize();
  py::class_<DecayTable>(module, "DecayTable", "Species that decay in flight, and their modes.")
      .def(py::init(&make_decays), py::arg("species"), py::arg("modes"), py::arg("products"));
}

void bind_matter(py::module_& module) {
  module.attr("CORE_SIGMAS") = core_sigmas;
  module.attr("USUAL_MOMENTUM_ERROR") = usual_momentum_error;
  module.def(
      "momentum_error",
      [](const Detector& detector, double p, double mass, double charge, double tanl) {
        return track_matter(detector, tanl, particle(p, mass, charge)).error;
      },
      py::arg("detector"), py::kw_only(), py::arg("p"), py::arg("mass"), py::arg("charge") = 1.0,
      py::arg("tanl") = 0.0,
      "Relative error of the momentum without straggling that the fit counts losses for, of a particle from "
      "the origin.");
  module.def(
      "light_cut",
      [](const Detector& detector, double p, double mass, double charge, double tanl) {
        const Kinematics start = particle(p, mass, charge);
        return light_cut(start, track_matter(detector, tanl, start)) / p;
      },
      py::arg("detector"), py::kw_only(), py::arg("p"), py::arg("mass"), py::arg("charge"),
      py::arg("tanl") = 0.0,
      "Unseen loss above which the fit of an electron from the origin counts none, as a share of p.");
  module.def(
      "total_matter",
      [](const Detector& detector, double tanl) {
        const TrackMatter total = total_matter(detector, tanl);
        return py::make_tuple(total.x0, total.xi, total.chi_c2);
      },
      py::arg("detector"), py::arg("tanl"),
      "Unseen radiation lengths and xi beta^2 (GeV), and (chi_c p beta)^2 (GeV^2), along a straight line "
      "from the origin.");
  module.def(
      "scattering_angle",
      [](const Detector& detector, int slab, double path, double p, double mass, double charge,
         double track_chi_c2) {
        const Kinematics k = particle(p, mass, charge);
        TrackMatter track;
        track.chi_c2 = track_chi_c2;
        return std::sqrt(scattering_variance(slab_of(detector, slab), path, k, k, track));
      },
      py::arg("detector"), py::arg("slab"), py::kw_only(), py::arg("path"), py::arg("p"), py::arg("mass"),
      py::arg("charge") = 1.0, py::arg("track_chi_c2"),
      "Plane multiple-scattering angle, rad, used by the fit for a slab of a track that crosses "
      "track_chi_c2.");
  module.def(
      "restricted_loss",
      [](const Detector& detector, int slab, double path, double p, double mass, double charge, double cut) {
        return restricted_loss(slab_of(detector, slab), path, particle(p, mass, charge), cut);
      },
      py::arg("detector"), py::arg("slab"), py::kw_only(), py::arg("path"), py::arg("p"), py::arg("mass"),
      py::arg("charge") = 1.0, py::arg("cut"),
      "Mean energy loss (GeV) in a slab by collisions below the cut (GeV); path in units of normal "
      "incidence.");
}

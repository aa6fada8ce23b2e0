#include "bindings/matter.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>

#include <utility>
#include <vector>

#include "bindings/arrays.hpp"
#include "matter/decay_table.hpp"
#include "matter/loss.hpp"
#include "matter/scattering.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// Modes and products come as flat columns: mode i belongs to species[of_species[i]], product k to mode
// of_mode[k].
DecayTable make_decays(const py::dict& species, const py::dict& modes, const py::dict& products) {
  const auto pdg = take<std::int32_t>(species, "pdg"), of_species = take<std::int32_t>(modes, "species"),
             spectrum = take<std::int32_t>(modes, "spectrum"), of_mode = take<std::int32_t>(products, "mode"),
             product_pdg = take<std::int32_t>(products, "pdg"),
             charge = take<std::int32_t>(products, "charge");
  const auto mass = take<double>(species, "mass"), lifetime = take<double>(species, "lifetime"),
             fraction = take<double>(modes, "fraction"), product_mass = take<double>(products, "mass");
  DecayTable table;
  for (py::ssize_t i = 0; i < pdg.size(); ++i)
    table.species.push_back({.pdg = pdg.at(i), .mass = mass.at(i), .lifetime = lifetime.at(i), .modes = {}});
  std::vector<std::vector<DecayProduct>> products_of(static_cast<std::size_t>(of_species.size()));
  for (py::ssize_t k = 0; k < of_mode.size(); ++k) {
    products_of.at(static_cast<std::size_t>(of_mode.at(k)))
        .push_back({.pdg = product_pdg.at(k), .charge = charge.at(k), .mass = product_mass.at(k)});
  }
  for (py::ssize_t i = 0; i < of_species.size(); ++i) {
    table.species.at(static_cast<std::size_t>(of_species.at(i)))
        .modes.push_back({.fraction = fraction.at(i),
                          .spectrum = static_cast<DecaySpectrum>(spectrum.at(i)),
                          .products = std::move(products_of[static_cast<std::size_t>(i)])});
  }
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
  module.attr("CORE_CUT_XI") = core_cut_xi;
  module.attr("USUAL_MOMENTUM_ERROR") = usual_momentum_error;
  module.attr("CORE_CUT_SHARE") = core_cut_share(usual_momentum_error);
  module.def(
      "total_matter",
      [](const Detector& detector, double tanl) {
        const TrackMatter total = total_matter(detector, tanl);
        return py::make_tuple(total.x0, total.xi, total.chi_c2);
      },
      py::arg("detector"), py::arg("tanl"),
      "Radiation lengths, xi beta^2 (GeV) and (chi_c p beta)^2 (GeV^2) along a straight line from the "
      "origin.");
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

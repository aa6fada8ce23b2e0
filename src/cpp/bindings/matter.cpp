#include "bindings/matter.hpp"

#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "matter/loss.hpp"
#include "matter/scattering.hpp"
#include "simulation/transport/slabs.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

py::dict pass_slabs(const Detector& detector, double p, double mass, double charge, std::size_t n,
                    std::uint64_t seed, std::uint64_t first) {
  SlabResults out;
  {
    py::gil_scoped_release release;
    out = through_slabs(detector, particle(p, mass, charge), first, n, seed);
  }
  std::vector<std::int8_t> status;
  status.reserve(n);
  for (const TransportStatus s : out.status) status.push_back(static_cast<std::int8_t>(s));
  py::dict columns;
  columns["angle_1"] = to_numpy(std::move(out.angle_1));
  columns["angle_2"] = to_numpy(std::move(out.angle_2));
  columns["shift_1"] = to_numpy(std::move(out.shift_1));
  columns["shift_2"] = to_numpy(std::move(out.shift_2));
  columns["loss"] = to_numpy(std::move(out.loss));
  columns["status"] = to_numpy(std::move(status));
  return columns;
}

}  // namespace

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
  module.def(
      "through_slabs", &pass_slabs, py::arg("detector"), py::kw_only(), py::arg("p"), py::arg("mass"),
      py::arg("charge"), py::arg("n"), py::arg("seed"), py::arg("first") = 0,
      "Pass n particles through the detector's slabs as plane layers at normal incidence, counting from "
      "number `first`: columns angle_1, angle_2 (rad), shift_1, shift_2 (mm), loss (GeV), status.");
}

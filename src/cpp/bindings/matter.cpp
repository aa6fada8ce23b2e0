#include <pybind11/pybind11.h>

#include "bindings/arrays.hpp"
#include "matter/moments.hpp"
#include "matter/sampling.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

const Slab& slab_of(const Detector& detector, int index) {
  return detector.slabs.at(static_cast<std::size_t>(index));
}

}  // namespace

void bind_matter(py::module_& module) {
  module.attr("CORE_CUT") = core_cut;
  module.def(
      "total_matter",
      [](const Detector& detector, double tanl) {
        const TrackMatter total = total_matter(detector, tanl);
        return py::make_tuple(total.x0, total.xi);
      },
      py::arg("detector"), py::arg("tanl"),
      "Radiation lengths and xi beta^2 (GeV) along a straight line from the origin.");
  module.def(
      "scattering_angle",
      [](double p, double mass, double x0, double track_x0) {
        return std::sqrt(
            scattering_variance(Kinematics(p, mass), Kinematics(p, mass), x0, TrackMatter(track_x0, 1)));
      },
      py::kw_only(), py::arg("p"), py::arg("mass"), py::arg("x0"), py::arg("track_x0"),
      "Plane multiple-scattering angle, rad, of x0 radiation lengths on a track that crosses track_x0 in "
      "all.");
  module.def(
      "restricted_loss",
      [](const Detector& detector, int slab, double path, double p, double mass, double cut) {
        return restricted_loss(slab_of(detector, slab), path, Kinematics(p, mass), cut);
      },
      py::arg("detector"), py::arg("slab"), py::kw_only(), py::arg("path"), py::arg("p"), py::arg("mass"),
      py::arg("cut"),
      "Mean energy loss (GeV) in a slab by collisions below the cut (GeV); path in units of normal "
      "incidence.");
  module.def(
      "core_loss",
      [](const Detector& detector, int slab, double path, double p, double mass, double track_xi) {
        const LossMoments m =
            core_loss(slab_of(detector, slab), path, Kinematics(p, mass), TrackMatter(1, track_xi));
        return py::make_tuple(m.loss, m.variance, m.slope);
      },
      py::arg("detector"), py::arg("slab"), py::kw_only(), py::arg("path"), py::arg("p"), py::arg("mass"),
      py::arg("track_xi"), "Loss (GeV), its variance, and d(loss)/dp that the fit uses.");
  module.def(
      "sample_loss",
      [](const Detector& detector, int slab, double path, double p, double mass, std::uint64_t seed,
         py::ssize_t n) {
        std::vector<double> values;
        values.reserve(static_cast<std::size_t>(n));
        for (py::ssize_t i = 0; i < n; ++i) {
          values.push_back(sample_loss(slab_of(detector, slab), path, Kinematics(p, mass),
                                       Stream(seed, static_cast<std::uint64_t>(i), 0), 0));
        }
        return to_numpy(std::move(values));
      },
      py::arg("detector"), py::arg("slab"), py::kw_only(), py::arg("path"), py::arg("p"), py::arg("mass"),
      py::arg("seed"), py::arg("n"), "Energy losses (GeV) of n particles in a slab.");
}

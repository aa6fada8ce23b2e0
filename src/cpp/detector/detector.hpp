// The detector in the core: plain numbers, ordered from the beam line outward, made by `cgemit.detector` from
// the user's description, whose columns the structs name (common/columns.hpp). Lengths in mm, angles in rad,
// field in T.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <memory>
#include <tuple>
#include <utility>
#include <vector>

#include "common/columns.hpp"
#include "detector/field/field.hpp"
#include "detector/gap.hpp"

namespace cgemit {

// Velocity-dependent properties of a slab are tabulated against ln(beta gamma), on one grid for all slabs.
inline constexpr int loss_points = 161;
inline constexpr double loss_grid_first = -3.0;  // ln(beta gamma)
inline constexpr double loss_grid_step = 0.1, loss_grid_per_step = 10;

// The ends of a part along the beam, mm, on either side of z = 0. The upper one is excluded: of two parts
// that meet there a track crosses one. Neither `hold` nor `miss` holds of a z that is no number.
struct Ends {
  double low, high;

  template <class T>
  mask_of<T> hold(const T& z, double margin = 0) const {
    return (z >= low - margin) & (z < high + margin);
  }
  template <class T>
  mask_of<T> miss(const T& z, double margin = 0) const {
    return (z < low - margin) | (z >= high + margin);
  }
  // Distance from z = 0 of the end that tracks with this tanl fly to; negative if it is behind z = 0.
  template <class T>
  T ahead(const T& tanl) const {
    return select(tanl < 0.0, T(-low), T(high));
  }
  double half() const { return 0.5 * (high - low); }
  double middle() const { return 0.5 * (low + high); }

  static constexpr auto columns() {
    return std::tuple(Column("min", &Ends::low), Column("max", &Ends::high));
  }
};

// One chemical element of a slab.
struct Component {
  double z, a;   // atomic number and weight, g/mol
  double moles;  // mol/cm^2 at normal incidence

  static constexpr auto columns() {
    return std::tuple(Column("z", &Component::z), Column("a", &Component::a),
                      Column("moles", &Component::moles));
  }
};

// One point of the loss table.
struct SlabPoint {
  double log_term;       // -2 ln(I/GeV) - delta - 2 C/Z, weighted by xi
  double log_screening;  // ln of the screening angle squared, in momentum transfer (GeV/c)^2, weighted by
                         // chi_c^2
  double soft;           // GeV^2: plane variance of soft scatters times (p beta)^2, at normal incidence
};

// Scattering on one element, for scatters that are drawn one by one.
struct HardScatterer {
  double up_to;      // running sum of the rates, 1 for the last element
  double z;          // atomic number: z scatters on the nucleus for each one on an electron
  double screening;  // (GeV/c)^2, for beta = 1
  double slow;       // the screening grows with 1/beta^2: screening (1 + slow/beta^2)/(1 + slow)
  double size;       // (GeV/c)^-2, radius of the nucleus squared over 12
};

// Holes through a slab that is part of a GEM foil: a hexagonal lattice of circles. Their radius is `waist` in
// the middle of the foil and grows by `widening` per mm from there; copper has widening 0.
struct Holes {
  int foil;      // running number of the foil; its parts share their holes
  double pitch;  // mm, 0 for a slab without holes
  double waist;  // mm
  double widening;
  double begin, end;  // mm, where the slab begins and ends, outward from the middle of the foil

  static constexpr auto columns() {
    return std::tuple(Column("foil", &Holes::foil), Column("pitch", &Holes::pitch),
                      Column("waist", &Holes::waist), Column("widening", &Holes::widening),
                      Column("begin", &Holes::begin), Column("end", &Holes::end));
  }
};

// What fills the space between parts.
enum class Filler : std::uint8_t { none, air, chamber_gas };

// A cylindrical shell of matter, or several neighbouring shells merged to one scatterer, acting at `radius`.
// What every crossing reads comes first, in one cache line.
struct alignas(64) Slab {
  double radius;  // mm, centroid of the scattering power
  double spread;  // mm, standard deviation of the scattering power about `radius`, along the radius
  Ends ends;      // no matter beyond
  double xi;      // GeV, (K/2) sum of Z/A times mass thickness at normal incidence; Landau's xi is xi/beta^2
  // Derived (`matter/scattering.hpp`), at normal incidence:
  double chi_c2;            // GeV^2, (chi_c p beta)^2 of nuclei and electrons
  double chi_c2_electrons;  // GeV^2, the electrons' part of it
  // Derived from the shell:
  double least_outward;  // mm, P of a track that grazes the shell
  int gap;               // index of the CGEM layer whose drift gap this is, or -1
  Filler filler;
  bool shifts;  // derived: whether shifts inside the slab matter: below 5 um at 1 GeV/c any hit error exceeds
                // them
  // Derived, of `Detector::parts`: range of tanl of straight lines from the origin to those outside of the
  // slab, and the number of those that are not outside.
  Ends slopes_beyond{0, 0};
  std::size_t parts_inside = 0;
  // Derived, of chamber gas: whether wires outside of it reach steeper lines from the origin than all wires
  // up to here. Tracks beyond its end have not left the chamber.
  bool reopens = false;

  double acting = HUGE_VAL;  // GeV^2 at normal incidence, chi_c^2 of the matter that acts with this slab, its
                             // own included, times (p beta)^2; infinite: all (`share_scattering`)
  // (GeV/c)^-2: of the parameters that scatters here move, the variance by hits over that by scattering, and
  // over (p beta)^2 of a unit charge.
  double by_hits = 0;
  // Of a loss here, the share that the fit takes for another kappa at the origin (`share_loss`): 1 before the
  // first hit, 0 behind the last. Its inverse scales the cut of the loss.
  double unseen = 1, per_unseen = 1, log_per_unseen = 0;
  double x0;            // thickness in radiation lengths at normal incidence
  double r_in;          // mm
  double r_out;         // mm
  Holes holes;          // pitch 0: none
  std::uint32_t place;  // RNG counter `place`
  std::vector<Component> components;
  std::array<SlabPoint, loss_points> table;
  // Derived, of scatters with a larger transfer, which are drawn one by one:
  double hard_from;  // (GeV/c)^2
  double hard_rate;  // times 1/beta^2: their expected number
  std::vector<HardScatterer> hard;

  // Components, holes and table come in tables of their own.
  static constexpr auto columns() {
    return std::tuple(Column("r_in", &Slab::r_in), Column("r_out", &Slab::r_out),
                      Column("radius", &Slab::radius), Column("spread", &Slab::spread),
                      Column("z_", &Slab::ends), Column("x0", &Slab::x0), Column("xi", &Slab::xi),
                      Column("gap", &Slab::gap), Column("filler", &Slab::filler));
  }
};

// Where a part is, against its place in the description. A point p of the beam's axes is turn (p - shift) in
// the part's own.
struct Placement {
  bool moved = false;                                     // derived
  std::array<double, 3> shift{};                          // mm
  std::array<double, 9> turn{1, 0, 0, 0, 1, 0, 0, 0, 1};  // rows of a rotation

  static constexpr auto columns() {
    return std::tuple(Column("shift", &Placement::shift), Column("turn", &Placement::turn));
  }
};

inline constexpr int most_sheets = 8;  // of a layer

// One cylindrical layer with its readout, of two views or one: a GEM layer, or a sensor that measures
// positions.
struct MeasuringLayer {
  double r_readout;  // mm, radius of X = r_readout (phi - phi_first)
  double r_gap_in;   // mm, cathode side of the drift gap, or inner face of the sensor
  double r_gap_out;  // mm, first foil, or outer face of the sensor
  Ends ends;         // of the active area
  double pitch_x;    // mm
  double pitch_v;    // mm
  double stereo;     // rad, signed
  double offset_v;   // V of the edge where V strip 0 begins, in units of pitch_v
  int sheets;
  int strips_x;                               // per sheet
  int strips_v;                               // per sheet
  std::array<double, most_sheets> phi_first;  // rad, edge of each sheet (X = 0); others are not read
  int gid_first;                  // running number of the layer's first strip: sheet by sheet, X then V
  double cos_stereo, sin_stereo;  // derived: -dV/dz is the sine of the stereo angle over 1 + z_scale
  Placement placement = {};
  double dead_seam = 0;             // mm, width about each edge of a sheet where nothing is measured
  double dead_ends = 0;             // mm, length at each end of the layer where nothing is measured
  double lorentz_shift = 0;         // mm of X, from mid-gap to the anode, in readouts without drift
  double z_scale = 0;               // lengths along the beam of the strip pattern are longer by this
  bool has_x = true, has_v = true;  // views that are measured
  double slope = 0;                 // growth of errors with the projected path, added in quadrature
  // Of a layer of one sheet: ladders around the beam, the gap between two, and X of the middle of a gap, mm.
  int ladders = 0;
  double ladder_gap = 0, ladder_first = 0;

  static constexpr auto columns() {
    return std::tuple(
        Column("r_readout", &MeasuringLayer::r_readout), Column("r_gap_in", &MeasuringLayer::r_gap_in),
        Column("r_gap_out", &MeasuringLayer::r_gap_out), Column("z_", &MeasuringLayer::ends),
        Column("pitch_x", &MeasuringLayer::pitch_x), Column("pitch_v", &MeasuringLayer::pitch_v),
        Column("stereo", &MeasuringLayer::stereo), Column("offset_v", &MeasuringLayer::offset_v),
        Column("sheets", &MeasuringLayer::sheets), Column("strips_x", &MeasuringLayer::strips_x),
        Column("strips_v", &MeasuringLayer::strips_v), Column("phi_first", &MeasuringLayer::phi_first),
        Column("gid_first", &MeasuringLayer::gid_first), Column("placement_", &MeasuringLayer::placement),
        Column("dead_seam", &MeasuringLayer::dead_seam), Column("dead_ends", &MeasuringLayer::dead_ends),
        Column("lorentz_shift", &MeasuringLayer::lorentz_shift), Column("z_scale", &MeasuringLayer::z_scale),
        Column("has_x", &MeasuringLayer::has_x), Column("has_v", &MeasuringLayer::has_v),
        Column("slope", &MeasuringLayer::slope), Column("ladders", &MeasuringLayer::ladders),
        Column("ladder_gap", &MeasuringLayer::ladder_gap),
        Column("ladder_first", &MeasuringLayer::ladder_first));
  }

  // Whether an X lies between ladders, or beside them by less than a margin.
  template <class T>
  mask_of<T> between_ladders(const T& x, double margin = 0) const {
    if (ladders == 0) return mask_of<T>(false);
    const double width = sheet_width() / ladders;
    const T off = x - ladder_first;
    return abs(off - width * nearest(off * (1 / width))) < 0.5 * ladder_gap + margin;
  }
  bool has(bool x) const { return x ? has_x : has_v; }
  double r_mid() const { return 0.5 * (r_gap_in + r_gap_out); }
  double sheet_width() const { return strips_x * pitch_x; }  // mm, in X
  double z_ref() const { return (stereo > 0 ? ends.high : ends.low) * (1 + z_scale); }
};

// A sense wire: its point at z = 0 and its unit direction (towards +z).
template <class T>
struct WireOf {
  T x, y;
  T ex, ey, ez;

  friend WireOf select(const mask_of<T>& m, const WireOf& a, const WireOf& b) {
    return {select(m, a.x, b.x), select(m, a.y, b.y), select(m, a.ex, b.ex), select(m, a.ey, b.ey),
            select(m, a.ez, b.ez)};
  }
};
using Wire = WireOf<double>;

// The wires of a layer, one per cell, shared by detectors with the same chamber: variants are many, wires
// thousands.
class PlacedWires {
 public:
  PlacedWires() = default;
  explicit PlacedWires(std::vector<Wire> wires)
      : wires_(std::make_shared<const std::vector<Wire>>(std::move(wires))), first_(wires_->data()) {}

  const Wire& operator[](std::size_t wire) const { return first_[wire]; }
  const Wire& at(std::size_t wire) const { return wires_->at(wire); }

 private:
  std::shared_ptr<const std::vector<Wire>> wires_;
  const Wire* first_ = nullptr;
};

// A change of the slope of an error against drift distance.
struct ErrorRamp {
  double from;    // mm
  double change;  // of the slope from there on

  static constexpr auto columns() {
    return std::tuple(Column("from", &ErrorRamp::from), Column("change", &ErrorRamp::change));
  }
};

// A point of the relation of drift distance and time.
struct DriftPoint {
  double distance, time;  // mm, ns

  bool operator==(const DriftPoint&) const = default;

  static constexpr auto columns() {
    return std::tuple(Column("distance", &DriftPoint::distance), Column("time", &DriftPoint::time));
  }
};

// How far the wires of a layer are displaced at one end: turned about the beam line, then shifted.
struct EndShift {
  double x = 0, y = 0;  // mm
  double rotation = 0;  // rad

  static constexpr auto columns() {
    return std::tuple(Column("x", &EndShift::x), Column("y", &EndShift::y),
                      Column("rotation", &EndShift::rotation));
  }
};

// How far the end of one wire is displaced, before it moves with the others: outward, and along phi.
struct WireEndShift {
  double r = 0, phi = 0;  // mm

  static constexpr auto columns() {
    return std::tuple(Column("r", &WireEndShift::r), Column("phi", &WireEndShift::phi));
  }
};
struct WireShift {
  WireEndShift east, west;

  static constexpr auto columns() {
    return std::tuple(Column("east_", &WireShift::east), Column("west_", &WireShift::west));
  }
};

// One layer of drift cells around straight, possibly stereo, wires. Cells and their borders are where the
// description puts them; `placed` are the wires where they are.
struct WireLayer {
  int number;  // layer number of the experiment
  int cells;
  double r_end;        // mm, wire radius at both ends
  Ends ends;           // of the wires
  double twist;        // rad, azimuth at the +z end minus azimuth at the -z end
  double phi_east;     // rad, azimuth of wire 0 at the +z end
  double sigma;        // mm, error of the drift distance at the wire
  double sigma_slope;  // change of that error per mm of drift distance
  double efficiency;
  int gid_first;          // running number of the layer's wire 0
  EndShift east, west;    // of the ends at +z and at -z
  Placement placement{};  // of the layer with its ends, in the chamber
  // Of each wire, whether it gives no usable hit, since it is dead or hot; empty: none.
  std::vector<std::uint8_t> masked;
  std::vector<DriftPoint> relation;  // both rising; at least two points
  std::vector<WireShift> shifts;     // of each wire; empty: none
  // Derived from the above: one wire per cell; distance from the beam line is
  // sqrt(waist + flare (z - middle)^2).
  PlacedWires placed;
  double half_length, middle;  // mm, of the wires along the beam
  double waist, flare, tan_half_twist;
  double per_radian;             // cells per radian
  double twist_per_z;            // 1/mm, tan_half_twist/half_length
  std::vector<ErrorRamp> ramps;  // of the error, where it is no straight line
  // Between these its wires are neighbours of those of other layers.
  Ends borders{-HUGE_VAL, HUGE_VAL};

  // Masked wires, relation, shifts and ramps come in rows of their own.
  static constexpr auto columns() {
    return std::tuple(Column("number", &WireLayer::number), Column("cells", &WireLayer::cells),
                      Column("r_end", &WireLayer::r_end), Column("z_", &WireLayer::ends),
                      Column("twist", &WireLayer::twist), Column("phi_east", &WireLayer::phi_east),
                      Column("sigma", &WireLayer::sigma), Column("sigma_slope", &WireLayer::sigma_slope),
                      Column("efficiency", &WireLayer::efficiency),
                      Column("gid_first", &WireLayer::gid_first), Column("east_", &WireLayer::east),
                      Column("west_", &WireLayer::west), Column("placement_", &WireLayer::placement));
  }

  bool has_borders() const { return borders.low > -HUGE_VAL || borders.high < HUGE_VAL; }
  bool is_masked(std::size_t wire) const { return !masked.empty() && masked[wire] != 0; }
};

// The cylinder of a slab that is no filler.
struct Extent {
  double radius;  // mm
  Ends ends;
};

// A surface that a track crosses on its outward path, ordered by radius.
struct Surface {
  double radius;  // mm
  bool is_slab;   // else a wire layer
  int index;      // into slabs or wires
};

// Cut of the fit's energy loss (`matter/loss.hpp`), of unseen losses: the solution W of
// W^2 = xi X W + sigmas2 S^2, with Landau's X of the track's unseen matter and the error S of the energy.
struct LossCut {
  double xi, sigmas2;
};
struct LossCuts {
  LossCut heavy, light;
  double variance;       // cut of the variance over that of the mean
  double radiation = 1;  // share of the bremsstrahlung that counts: 1, or 0 without it
};

// Relative errors of momenta without straggling, S/(p beta) of a particle: by hits, per GeV/c of transverse
// momentum over the charge, and by scattering, times beta. On a grid of transverse momenta over the charge
// (GeV/c, each `step` above the last in ln) and of tan(lambda), momenta first; a grid from tan(lambda) = 0 on
// holds for |tan(lambda)|. Without a grid, `constant` for all.
struct MomentumErrors {
  explicit MomentumErrors(double error) : constant(error) {}
  double constant;
  double log_first = 0, step = 0;
  std::vector<double> tanl, hits, scattered;
};

struct Detector {
  double bz;       // T, signed, at the origin
  FieldMap field;  // everywhere
  std::vector<Slab> slabs;
  std::vector<MeasuringLayer> layers;
  std::vector<WireLayer> wires;
  std::vector<GapMatter> gaps;    // one per layer; if empty, no electrons are followed
  std::vector<Surface> surfaces;  // by radius
  std::vector<Extent> parts;      // by radius
  LossCuts loss;
  MomentumErrors errors{0.0};
};

// Radius of the last surface that measures, mm; infinite without any.
double last_measurement(const Detector& detector);

// Whether all parts end equally far at both sides of z = 0.
bool has_equal_ends(const Detector& detector);

// tanl in the middle of the range where straight lines from the origin cross as many layers and layers of
// wires as possible.
double slope_through_most(const Detector& detector);

// Computes the quantities of wire layers that follow from the rest of their description.
void place_wires(std::vector<WireLayer>& layers, const Placement& chamber);

// Computes the quantities that follow from the rest of the description; `wires` are in place.
Detector make_detector(FieldMap field, std::vector<Slab> slabs, std::vector<MeasuringLayer> layers,
                       std::vector<WireLayer> wires, std::vector<GapMatter> gaps);

}  // namespace cgemit

#include "simulate/simulate.hpp"

#include <algorithm>
#include <cmath>

#include "common/angles.hpp"
#include "matter/foil.hpp"
#include "matter/ionization.hpp"
#include "matter/loss.hpp"
#include "matter/radiation.hpp"
#include "matter/scattering.hpp"
#include "motion/field_motion.hpp"
#include "motion/uniform.hpp"
#include "simulate/cells.hpp"

namespace cgemit {

namespace {

constexpr std::uint32_t inward_leg = 1U << 19;  // above any number of a particle

// One particle on its way. `Motion`: in the field that it flies through.
template <class Motion>
class Flight {
 public:
  Flight(const Detector& detector, const ParticleColumns& in, std::size_t row,
         const SimulateSettings& settings, std::uint64_t seed, Simulated& out)
      : detector_(detector),
        settings_(settings),
        motion_(detector),
        outward_(seed, static_cast<std::uint64_t>(in.event[row]),
                 static_cast<std::uint32_t>(in.particle[row])),
        // A slab that is crossed on the way in and again on the way out acts anew.
        stream_(seed, static_cast<std::uint64_t>(in.event[row]),
                static_cast<std::uint32_t>(in.particle[row]) | inward_leg),
        who_{in.event[row], in.particle[row]},
        charge_(in.charge[row]),
        now_(std::hypot(in.px[row], in.py[row], in.pz[row]), in.mass[row],
             projectile_of(in.mass[row], in.charge[row])),
        track_(total_matter(detector, in.pz[row] / std::hypot(in.px[row], in.py[row]))),
        cells_(detector, motion_),
        out_(out) {
    const double pt = std::hypot(in.px[row], in.py[row]);
    point_ = {in.x[row], in.y[row], in.z[row], in.px[row] / pt, in.py[row] / pt, in.pz[row] / pt, 0};
    motion_.bend(point_, charge_ / pt);
    stretch_ = std::sqrt(1 + point_.tanl * point_.tanl);
  }

  TransportStatus run() {
    const auto& places = detector_.places;
    auto next = std::ranges::upper_bound(places, point_.radius(), {}, &Place::radius);
    // Inward leg, if any: matter only.
    while (next != places.begin() && point_.outward() < 0) {
      const Place& inner = *std::prev(next);
      if (!motion_.to_cylinder(point_, inner.radius, arc_, false)) break;
      --next;
      arrive();
      if (inner.is_slab && !cross(inner.index)) return status_;
    }
    if (motion_.left()) return TransportStatus::left_field;
    stream_ = outward_;
    for (; next != places.end(); ++next) {
      const auto index = static_cast<std::size_t>(next->index);
      if (!next->is_slab) {
        // A helix that curls back below a slab may still pass by the next wires.
        const bool passed = pass_cells(index);
        if (!passed && motion_.left()) return TransportStatus::left_field;
        if (!passed && curled_) break;
      } else if (!curled_) {
        const bool is_gap = detector_.slabs[index].gap >= 0;
        const bool goes_on = is_gap ? cross_gap(detector_.slabs[index], next->index)
                                    : reach(next->radius) && cross(next->index);
        if (!goes_on && !curled_) return status_;
      }
    }
    if (curled_) return TransportStatus::curled;
    return TransportStatus::outside;
  }

 private:
  bool reach(double radius) {
    const bool reached = motion_.to_cylinder(point_, radius, arc_);
    curled_ = !reached && !motion_.left();
    if (motion_.left()) status_ = TransportStatus::left_field;
    if (reached) arrive();
    return reached;
  }

  double flight_time(double arc) const { return arc * stretch_ * now_.per_beta * (1 / speed_of_light); }

  void arrive() {
    time_ += flight_time(arc_);
    if constexpr (!Motion::keeps_dip) stretch_ = std::sqrt(1 + point_.tanl * point_.tanl);
  }

  // Scatters and slows down at the slab's centroid, where the point is. False if the flight ends here.
  bool cross(int index) {
    const Slab& slab = detector_.slabs[static_cast<std::size_t>(index)];
    deposit_ = 0;  // stays 0 beyond the ends
    if (std::abs(point_.z) > slab.half_length) {
      status_ = TransportStatus::end;
      return !slab.ends;
    }
    const double path =
        path_factor(slab, stretch_, std::abs(point_.outward())) * foil_fraction(slab, point_, stream_);
    if (path == 0) return true;
    const std::uint32_t place = slab.place;
    const double loss = lose(slab, path, place);
    if (now_.kinetic() - loss < least_kinetic) {
      status_ = TransportStatus::stopped;
      return false;
    }
    const Kinematics after = now_.after_loss(loss);
    if (settings_.fluctuations == Fluctuations::full) {
      apply_kick(point_, sample_scattering(slab, path, now_, after, stream_, place));
    } else if (settings_.fluctuations == Fluctuations::gaussian) {
      scatter(slab, path, after, place);
    }
    now_ = after;
    stretch_ = std::sqrt(1 + point_.tanl * point_.tanl);
    motion_.bend(point_, charge_ * stretch_ * now_.per_p);
    return true;
  }

  // The energy lost. The fit's noise may be negative in thin matter; what is left in a gap stays its expected
  // value.
  double lose(const Slab& slab, double path, std::uint32_t place) {
    if (settings_.fluctuations == Fluctuations::full) {
      deposit_ = sample_loss(slab, path, now_, stream_, place);
      if (!now_.is_light()) return deposit_;
      return deposit_ + sample_radiation(now_.energy, slab.x0 * path, stream_, place);
    }
    const LossMoments core = core_loss(slab, path, now_, track_);
    deposit_ = core.loss;
    if (settings_.fluctuations == Fluctuations::off) return core.loss;
    return core.loss + std::sqrt(core.variance) * stream_.normals(Purpose::energy_loss, place)[0];
  }

  // As the fit assumes.
  void scatter(const Slab& slab, double path, const Kinematics& after, std::uint32_t place) {
    const double sigma = std::sqrt(scattering_variance(slab, path, now_, after, track_));
    const Block words = stream_.block(Purpose::scattering, place);
    const auto normal = [&words](std::size_t i) { return normal_quantile(open_unit(words[i])); };
    Kick kick{sigma * normal(0), sigma * normal(1), 0, 0};
    if (slab.shifts) {
      kick.shift_1 = sigma * slab.spread * path * normal(2);
      kick.shift_2 = sigma * slab.spread * path * normal(3);
    }
    apply_kick(point_, kick);
  }

  // A drift gap: entry, middle and exit of one helix, then the gas acts in the middle.
  bool cross_gap(const Slab& slab, int index) {
    const CgemLayer& layer = detector_.cgem[static_cast<std::size_t>(slab.gap)];
    HelixPoint entry = point_;
    double arc = 0;
    const bool enters = motion_.to_cylinder(entry, layer.r_gap_in, arc) && arc >= 0;
    if (!reach(slab.radius)) return false;
    HelixPoint exit = point_;
    double rest = 0;
    const bool leaves = motion_.to_cylinder(exit, layer.r_gap_out, rest);
    const HelixPoint middle = point_;
    const Kinematics inside = now_;
    const double path = (arc_ - arc + rest) * stretch_, time = time_;
    const bool goes_on = cross(index);
    if (enters && leaves && deposit_ > 0) {
      const GapResult left = fill_gap(slab.gap, entry, exit, path, inside, slab.place);
      out_.truths.append(who_, {slab.gap, entry, middle, exit, inside.p, path, time, left});
    }
    return goes_on;
  }

  // What the particle leaves in a gap: ionization, or the mean without fluctuations.
  GapResult fill_gap(int layer, const HelixPoint& entry, const HelixPoint& exit, double path,
                     const Kinematics& k, std::uint32_t place) {
    if (settings_.fluctuations != Fluctuations::full || detector_.gaps.empty()) return {deposit_ / keV, 0, 0};
    deposits_.clear();
    const GapResult left =
        ionize(detector_.gaps[static_cast<std::size_t>(layer)], {entry, exit, motion_.bz(entry), path}, k,
               stream_, place, settings_.deltas, settings_.steps, deposits_);
    const auto truth = static_cast<std::int64_t>(out_.truths.event.size());
    for (const Deposit& deposit : deposits_) out_.steps.append(who_, layer, deposit, truth);
    return left;
  }

  // False if the track turns back below the layer's cells.
  bool pass_cells(std::size_t index) {
    const WireLayer& layer = detector_.wires[index];
    CellRange cells{};
    if (!cells_.find(index, point_, cells)) return false;
    for (int cell = cells.first; cell <= cells.last; ++cell)
      record_cell(layer, ((cell % layer.cells) + layer.cells) % layer.cells, cells);
    return true;
  }

  void record_cell(const WireLayer& layer, int cell, const CellRange& range) {
    HelixPoint closest = range.at_wires;
    Approach approach{};
    if (!motion_.approach(closest, layer.placed[static_cast<std::size_t>(cell)], approach)) return;
    const double time = time_ + flight_time(approach.arc + range.arc);
    const bool behind_vertex = time < 0;
    if (behind_vertex || std::abs(approach.z_wire) > layer.half_length) return;
    WireTruths& t = out_.wire_truths;
    t.event.push_back(who_.event);
    t.particle.push_back(who_.particle);
    t.layer.push_back(layer.number);
    t.wire.push_back(cell);
    t.doca.push_back(approach.doca);
    t.side.push_back(approach.doca > 0 ? 1 : -1);
    t.x.push_back(closest.x);
    t.y.push_back(closest.y);
    t.z.push_back(closest.z);
    t.time.push_back(time);
  }

  const Detector& detector_;
  const SimulateSettings& settings_;
  Motion motion_;
  Stream outward_, stream_;
  ParticleNumber who_;
  double charge_, time_ = 0, arc_ = 0, deposit_ = 0;
  HelixPoint point_{};
  double stretch_;  // path per transverse arc
  Kinematics now_;
  TrackMatter track_;
  CellFinder<Motion> cells_;
  TransportStatus status_ = TransportStatus::outside;
  bool curled_ = false;  // past the outermost point: no cylinder lies ahead
  std::vector<Deposit> deposits_;
  Simulated& out_;
};

}  // namespace

TransportStatus simulate_one(const Detector& detector, const ParticleColumns& particles, std::size_t row,
                             const SimulateSettings& settings, std::uint64_t seed, Simulated& out) {
  if (particles.charge[row] == 0) return TransportStatus::neutral;
  if (particles.px[row] == 0 && particles.py[row] == 0) return TransportStatus::end;
  if (!detector.field.is_uniform())
    return Flight<FieldMotion>(detector, particles, row, settings, seed, out).run();
  return Flight<UniformMotion>(detector, particles, row, settings, seed, out).run();
}

void reserve(const Detector& detector, const SimulateSettings& settings, std::size_t n, Simulated& out) {
  out.status.reserve(n);
  out.truths.reserve(n * detector.cgem.size());
  if (settings.deltas && settings.fluctuations == Fluctuations::full) out.steps.reserve(10 * n);
  // Tracks pass a little more than one cell of a layer.
  out.wire_truths.reserve(n * (detector.wires.size() + detector.wires.size() / 8));
}

void simulate(const Detector& detector, const ParticleColumns& particles, const SimulateSettings& settings,
              std::uint64_t seed, Simulated& out) {
  reserve(detector, settings, particles.event.size(), out);
  for (std::size_t row = 0; row < particles.event.size(); ++row) {
    out.status.push_back(simulate_one(detector, particles, row, settings, seed, out));
  }
}

}  // namespace cgemit

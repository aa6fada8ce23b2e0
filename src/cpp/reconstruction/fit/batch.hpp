// Many tracks: their seeds, groups of tracks that cross similar surfaces, and the fits.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "kalman/builder.hpp"
#include "reconstruction/fit/group_fit.hpp"
#include "reconstruction/fit/seed.hpp"

namespace cgemit {

template <class T>
class BatchFit {
 public:
  BatchFit(const Detector& detector, const FitInput& input, const FitSettings& settings,
           const FitOutput& output)
      : detector_(detector),
        input_(input),
        settings_(settings),
        out_(output),
        builder_(detector),
        breaks_(detector) {}

  void run() {
    std::vector<Start> starts;
    for (std::size_t track = 0; track < input_.tracks(); ++track) {
      out_.rows[track] = {};
      out_.rows[track].status = FitStatus::too_few_hits;
      clear(track);
      if (input_.count(track) <= parameters) continue;
      out_.rows[track].status = FitStatus::seed_failed;
      if (!input_.start.empty()) starts.push_back({track, key(track), {input_.start[track], HUGE_VAL}});
    }
    const bool kinks = GroupFit<T>::gives_kinks(settings_);
    const auto good = [this](std::size_t track) { return is_good(out_.rows[track]); };
    const auto settled = [this](std::size_t track) { return out_.rows[track].status == FitStatus::ok; };
    if (!input_.start.empty()) {
      fit_all(starts, false, kinks);
      std::erase_if(starts, [&](const Start& start) { return settled(start.track); });
    } else {
      // A circle takes three axial layers. With fewer, the clusters alone would make it.
      const bool axial = std::ranges::count(detector_.wires, 0.0, &WireLayer::twist) >= 3;
      fit_all(seeds(axial ? SeedFrom::wires_and_clusters : SeedFrom::azimuths, good), false, kinks);
      // After a poor seed the clusters would mislead the sides, so the wires are fitted first, alone.
      fit_all(seeds(SeedFrom::wires, good), true, kinks);
      fit_all(seeds(axial ? SeedFrom::azimuths : SeedFrom::wires_and_clusters, good), false, kinks);
      starts = seeds(SeedFrom::wires_and_clusters, settled);
    }
    // A fit that does not converge with kinks is repeated without.
    if (kinks) fit_all(starts, false, false);
    fit_all(undecided(), false, kinks);
    const int free = is_straight(detector_.bz) ? 4 : 5;  // parameters that the hits determine
    const int spot = settings_.beam[0] > 0 ? 2 : 0;
    for (std::size_t track = 0; track < input_.tracks(); ++track) {
      out_.rows[track].ndf = out_.rows[track].clusters + out_.rows[track].wires + spot - free;
      mark_left_out(out_.rows[track]);
      mark_unconstrained(out_.rows[track], input_.charge[track]);
    }
  }

 private:
  static constexpr std::size_t width = lanes_of<T>;

  struct Start {
    std::size_t track;
    std::uint64_t key;
    Seed seed;
  };

  // The rows of one attempt.
  struct Scratch {
    FitRow row;
    LastIteration last;
    DensityRow density;
    std::vector<HitRow> hits;
    std::vector<Measured> measured;
    std::vector<KinkRow> kinks;

    FitLane rows(std::size_t n, std::size_t slabs, const FitOutput& wanted) {
      row = {};
      hits.assign(n, HitRow{});
      density = {};
      FitLane to{&row,    wanted.hits != nullptr ? hits.data() : nullptr,  nullptr, nullptr,
                 nullptr, wanted.densities != nullptr ? &density : nullptr};
      if (wanted.last == nullptr) return to;
      measured.assign(n, Measured{});
      kinks.assign(slabs, KinkRow{});
      to.last = &last;
      to.measured = measured.data();
      to.kinks = kinks.data();
      return to;
    }
  };

  std::size_t slabs() const { return detector_.slabs.size(); }
  std::span<const Hit> hits(std::size_t track) const {
    return input_.hits.subspan(input_.first(track), input_.count(track));
  }
  std::span<const std::int8_t> sides(std::size_t track) const {
    return input_.side.subspan(input_.first(track), input_.count(track));
  }
  Projectile projectile(std::size_t track) const {
    const double kappa = input_.start.empty() ? 1 : input_.start[track].kappa;
    return projectile_of(input_.mass[track], kappa);
  }

  // Wrong sides or a wrong turn show up as a large chi-square or as many hits left out.
  static bool is_good(const FitRow& row) {
    const int used = row.clusters + row.wires;
    return row.status == FitStatus::ok && row.chi2 < 5 * used + 30 && 2 * row.outliers < used;
  }
  // A first helix that is millimetres off at the last wires takes these to be on the wrong side together, or
  // leaves them out until it is too late for them to return.
  static bool lost_hits(const FitRow& row) {
    return row.status == FitStatus::ok && 12 * row.outliers > row.clusters + row.wires;
  }
  // A helix through the few hits that it keeps is not the track of the candidate.
  static void mark_left_out(FitRow& row) {
    if (row.status == FitStatus::ok && row.outliers > row.clusters + row.wires)
      row.status = FitStatus::hits_left_out;
  }
  // Where the field is weak, or particles stop behind the first layers, a helix with any momentum fits the
  // hits. A fitted kappa that is far from 0 by chance does not measure the momentum that matter was given. A
  // few wires of one stereo angle say little of z: the errors along z are then those of the filter's prior.
  void mark_unconstrained(FitRow& row, double charge) const {
    if (row.status != FitStatus::ok) return;
    const auto cov = [&row](std::size_t i, std::size_t k) { return row.covariance[i][k]; };
    const auto as_prior = [&](std::size_t i) {
      const double sigma = most_error * settings_.prior_sigma[i];
      return !(cov(i, i) < sigma * sigma);
    };
    // ln p = ln sec(lambda) - ln |kappa|
    const double kappa = row.helix[2], tanl = row.helix[4], slope = tanl / (1 + tanl * tanl);
    const double variance =
        cov(2, 2) / (kappa * kappa) - 2 * slope * cov(2, 4) / kappa + slope * slope * cov(4, 4);
    const double in_matter = most_error * charge * std::sqrt(1 + tanl * tanl) / row.matter_p;
    const bool any_momentum =
        !(variance < most_error * most_error) || (row.matter_p > 0 && !(cov(2, 2) < in_matter * in_matter));
    if (any_momentum || as_prior(3) || as_prior(4)) row.status = FitStatus::unconstrained;
  }
  // Each hit that is left out counts as one just at the outlier cut, or at 5 standard deviations without a
  // cut.
  double chi2_per_hit(const FitRow& row) const {
    const double cut = settings_.outlier_pull > 0 ? settings_.outlier_pull : 5.0;
    return (row.chi2 + cut * cut * row.outliers) / std::max(row.clusters + row.wires + row.outliers, 1);
  }
  // Order of preference: a converged fit, one that has not converged, none.
  static int rank(FitStatus status) {
    return status == FitStatus::ok ? 2 : status == FitStatus::not_converged ? 1 : 0;
  }
  bool is_better(const FitRow& a, const FitRow& b) const {
    if (rank(a.status) != rank(b.status)) return rank(a.status) > rank(b.status);
    return rank(a.status) > 0 && chi2_per_hit(a) < chi2_per_hit(b);
  }

  // Sort key that is similar for tracks that cross similar surfaces, so that few lanes are idle: the clusters
  // and the layer of the last hit, then the number of hits in each eighth of the chamber.
  std::uint64_t key(std::size_t track) const {
    if (width == 1) return 0;
    std::uint64_t clusters = 0, wires = 0;
    for (const Hit& hit : hits(track)) {
      if (hit.view != View::wire) {
        ++clusters;
      } else {
        const auto eighth = 8 * static_cast<std::size_t>(hit.layer) / detector_.wires.size();
        wires += std::uint64_t{1} << (6 * (7 - eighth));
      }
    }
    return (std::min<std::uint64_t>(clusters, 255) << 48) ^ wires;
  }

  // First helices of all tracks that are not `done`, through the hits that `from` names.
  template <class Done>
  std::vector<Start> seeds(SeedFrom from, const Done& done) const {
    std::vector<Start> starts;
    for (std::size_t track = 0; track < input_.tracks(); ++track) {
      if (out_.rows[track].status == FitStatus::too_few_hits || done(track)) continue;
      const auto seed = seed_helix(detector_, hits(track), sides(track), from, input_.mass[track],
                                   input_.charge[track], settings_.momentum);
      if (seed) starts.push_back({track, key(track), *seed});
    }
    return starts;
  }

  // Tracks that lost hits, from their own helices with all hits and undecided sides.
  std::vector<Start> undecided() const {
    std::vector<Start> starts;
    for (std::size_t track = 0; track < input_.tracks(); ++track) {
      if (!lost_hits(out_.rows[track])) continue;
      const std::array<double, 5>& of = out_.rows[track].helix;
      starts.push_back({track, key(track), {{of[0], of[1] + 0.5 * pi, of[2], of[3], of[4]}, HUGE_VAL}});
    }
    return starts;
  }

  void fit_all(std::vector<Start> starts, bool wires_first, bool kinks) {
    if (width > 1) {
      std::ranges::stable_sort(starts, [this](const Start& a, const Start& b) {
        const double mass_a = input_.mass[a.track], mass_b = input_.mass[b.track];
        return mass_a != mass_b ? mass_a < mass_b : a.key < b.key;
      });
    }
    for (std::size_t first = 0; first < starts.size() && !input_.interrupted();) {
      const Projectile kind = kind_of(starts[first]);
      std::size_t n = 1;
      while (n < width && first + n < starts.size() && kind_of(starts[first + n]) == kind) ++n;
      fit_group(std::span(starts).subspan(first, n), kind, wires_first, kinks);
      first += n;
    }
  }

  Projectile kind_of(const Start& start) const {
    return projectile_of(input_.mass[start.track], start.seed.helix.kappa);
  }

  void fit_group(std::span<const Start> starts, Projectile kind, bool wires_first, bool kinks) {
    std::array<std::span<const Hit>, width> hits_of;
    std::array<std::span<const std::int8_t>, width> sides_of;
    std::array<FitLane, width> lanes;
    PerigeeOf<T> helix;
    SpeciesOf<T> species;
    T spread;
    species.projectile = kind;
    for (std::size_t k = 0; k < width; ++k) {
      const Start& start = starts[std::min(k, starts.size() - 1)];  // idle lanes hold a valid helix
      const Perigee& from = start.seed.helix;
      const int i = static_cast<int>(k);
      set_lane(helix.d, i, from.d);
      set_lane(helix.psi, i, from.psi);
      set_lane(helix.kappa, i, usable_kappa(from.kappa));
      set_lane(helix.z0, i, from.z0);
      set_lane(helix.tanl, i, from.tanl);
      set_lane(species.mass, i, input_.mass[start.track]);
      set_lane(species.charge, i, input_.charge[start.track]);
      set_lane(spread, i, start.seed.spread);
      if (k >= starts.size()) continue;
      hits_of[k] = hits(start.track);
      sides_of[k] = sides(start.track);
      lanes[k] =
          is_first(start.track) ? rows_of(start.track) : scratch_[k].rows(hits_of[k].size(), slabs(), out_);
    }
    builder_.build(std::span(hits_of).first(starts.size()), std::span(sides_of).first(starts.size()), group_);
    GroupFit<T>(detector_, settings_, group_, breaks_, input_.interrupted)
        .run(helix, spread, species, std::span(lanes).first(starts.size()), wires_first, kinks);
    for (std::size_t k = 0; k < starts.size(); ++k) {
      if (lanes[k].rows != &out_.rows[starts[k].track]) keep_better(starts[k].track, lanes[k]);
    }
  }

  // Clears the rows of the hits; the row of the track holds its status.
  void clear(std::size_t track) const {
    if (out_.hits != nullptr) std::fill_n(out_.hits + input_.first(track), input_.count(track), HitRow{});
    if (out_.densities != nullptr) out_.densities[track] = {};
    if (out_.last == nullptr) return;
    out_.last[track] = {};
    std::fill_n(out_.measured + input_.first(track), input_.count(track), Measured{});
    std::fill_n(out_.kinks + track * slabs(), slabs(), KinkRow{});
  }

  // A straight or undefined track gets a kappa close to that of a straight one.
  static double usable_kappa(double kappa) { return std::isfinite(kappa) && kappa != 0 ? kappa : 1e-9; }

  // The first attempt is written to the result; a later one replaces it only if it is better.
  bool is_first(std::size_t track) const { return out_.rows[track].status == FitStatus::seed_failed; }
  FitLane rows_of(std::size_t track) const {
    const std::size_t first = input_.first(track);
    return {out_.rows + track,
            out_.hits == nullptr ? nullptr : out_.hits + first,
            out_.last == nullptr ? nullptr : out_.last + track,
            out_.measured == nullptr ? nullptr : out_.measured + first,
            out_.kinks == nullptr ? nullptr : out_.kinks + track * slabs(),
            out_.densities == nullptr ? nullptr : out_.densities + track};
  }
  void keep_better(std::size_t track, const FitLane& found) const {
    const FitLane to = rows_of(track);
    if (!is_better(*found.rows, *to.rows)) return;
    *to.rows = *found.rows;
    const std::size_t n = input_.count(track);
    if (to.hits != nullptr) std::copy_n(found.hits, n, to.hits);
    if (to.densities != nullptr) *to.densities = *found.densities;
    if (to.last == nullptr) return;
    *to.last = *found.last;
    std::copy_n(found.measured, n, to.measured);
    std::copy_n(found.kinks, slabs(), to.kinks);
  }

  const Detector& detector_;
  const FitInput& input_;
  const FitSettings& settings_;
  const FitOutput& out_;
  GroupBuilder<T> builder_;
  Group<T> group_;
  Breaks<T> breaks_;
  std::array<Scratch, width> scratch_;
};

}  // namespace cgemit

#include "matter/ionization.hpp"

#include <algorithm>
#include <cmath>

#include "matter/draws.hpp"
#include "matter/electrons.hpp"
#include "matter/loss.hpp"
#include "matter/track.hpp"

namespace cgemit {

namespace {

// Blocks of random numbers. Gas: block 0 for counts, then sizes (four per block), then one block for each
// cluster and one for each fast electron; clusters beyond `most_clusters`, of slow or multiply charged
// particles, are drawn at further places. Solids: block 0 for the count, then two for each electron.
constexpr std::uint32_t cluster_blocks = 512, fast_blocks = 3072, spin_blocks = 2048;
constexpr int most_clusters = 2044, most_places = 1024, most_fast = 1023, most_solid = 2047;
constexpr double steepest =
    0.05;  // cosine to the radius above which the plane approximation of the layer fails

// Kinematics of the particle's collisions with free electrons; keV.
struct Collisions {
  const Kinematics& particle;
  double largest;    // largest transfer
  double kinematic;  // the same, if the two electrons of a collision can be distinguished
  double peak;       // largest value of `share`

  explicit Collisions(const Kinematics& k)
      : particle(k),
        largest(k.w_max() / keV),
        kinematic(k.is_light() ? k.kinetic() / keV : largest),
        peak(spectrum_peak(k.projectile)) {}

  // Rate of collisions with this transfer, relative to xi/(beta^2 E^2).
  double share(double energy) const {
    return energy > largest ? 0 : spectrum_share(particle, energy * keV, largest * keV);
  }
  // Cosine of the angle between the particle and the struck electron, from energy and momentum conservation.
  double cosine(double energy) const {
    constexpr double twice_rest = 2 * electron_mass / keV;
    return std::sqrt(std::min(energy * (kinematic + twice_rest) / (kinematic * (energy + twice_rest)), 1.0));
  }
};

class GapIonization {
 public:
  GapIonization(const GapMatter& matter, const GapCrossing& crossing, const Kinematics& k,
                const Stream& stream, std::uint32_t place, DeltaBatch& electrons, std::vector<Deposit>& out)
      : matter_(matter),
        crossing_(crossing),
        collisions_(k),
        stream_(stream),
        place_(place),
        electrons_(electrons),
        out_(out) {}

  // Clusters within the size table, and the electrons above it.
  void gas(double density, bool deltas, bool keep_clusters) {
    const Block counts = stream_.block(Purpose::ionization, place_);
    const int n =
        std::min(poisson(open_unit(counts[0]), density * crossing_.length), most_places * most_clusters);
    for (int first = 0; first < n; first += most_clusters) {
      place_of_clusters_ = place_ | static_cast<std::uint32_t>(first / most_clusters) << 16;
      draw_clusters(std::min(n - first, most_clusters), deltas, keep_clusters);
    }
    if (deltas) fast_electrons(open_unit(counts[1]));
  }

  // Electrons from the cathode and from behind the gap.
  void solids() {
    const Block count = stream_.block(Purpose::deltas, place_);
    const auto& slices = matter_.slices;
    if (slices.empty()) return;
    const double total = slices.back().rate;
    const double expected = total * collisions_.peak * collisions_.particle.charge2_per_beta2 *
                            crossing_.length / matter_.width();
    const int n = std::min(poisson(open_unit(count[0]), expected), most_solid);
    for (std::uint32_t i = 0; i < static_cast<std::uint32_t>(n); ++i) {
      const Block words = stream_.block(Purpose::deltas, place_, 1 + i);
      const DeltaSlice& slice =
          *std::ranges::upper_bound(slices, open_unit(words[0]) * total, {}, &DeltaSlice::rate);
      const double energy = slice.least_energy / open_unit(words[2]);
      const double spin = open_unit(stream_.block(Purpose::deltas, place_, spin_blocks + i)[0]);
      if (spin * collisions_.peak > collisions_.share(energy)) continue;
      const double w = slice.w_in + open_unit(words[1]) * (slice.w_out - slice.w_in);
      follow(solid_point(w), energy, open_unit(words[3]), w < 0 ? DeltaOrigin::cathode : DeltaOrigin::behind);
    }
  }

  int clusters() const { return clusters_; }

 private:
  // A point of the track and the direction of flight there, in the plane that touches the layer: u along r
  // phi.
  struct Start {
    double cosine, sine;  // of its azimuth
    double z, w;
    double du, dw, dz;
  };

  Start start(const HelixPoint& flight, double x, double y, double z, double w) const {
    const double cos_dip = 1 / std::sqrt(1 + flight.tanl * flight.tanl), r = std::sqrt(x * x + y * y);
    const double cosine = x / r, sine = y / r;
    return {cosine,
            sine,
            z,
            w,
            cos_dip * (flight.uy * cosine - flight.ux * sine),
            cos_dip * (flight.ux * cosine + flight.uy * sine),
            cos_dip * flight.tanl};
  }
  Start gas_point(double part) const {
    const HelixPoint &a = crossing_.entry, &b = crossing_.exit;
    const double x = a.x + part * (b.x - a.x), y = a.y + part * (b.y - a.y), z = a.z + part * (b.z - a.z);
    const double w = std::sqrt(x * x + y * y) - a.radius();
    return start(a, x, y, z, std::clamp(w, 0.0, matter_.width()));
  }
  Start solid_point(double w) const {
    const HelixPoint& edge = w < 0 ? crossing_.entry : crossing_.exit;
    const double slope = edge.outward() / edge.radius();
    const double outward = slope < 0 ? std::min(slope, -steepest) : std::max(slope, steepest);
    const double arc = (w < 0 ? w : w - matter_.width()) / outward;
    return start(edge, edge.x + arc * edge.ux, edge.y + arc * edge.uy, edge.z + arc * edge.tanl, w);
  }

  // The next n clusters, at one place.
  void draw_clusters(int n, bool deltas, bool keep_clusters) {
    BlocksAhead words(stream_, Purpose::ionization, place_of_clusters_, 1);
    for (std::uint32_t number = 0; number < static_cast<std::uint32_t>(n); ++number) {
      const std::uint32_t drawn = words[number];
      constexpr std::size_t few = 8;  // no branch predicts which of the small sizes it is
      std::size_t size = 0;
      for (std::size_t i = 0; i < few; ++i) size += drawn >= matter_.sizes[i];
      while (size >= few && size + 1 < matter_.sizes.size() && drawn >= matter_.sizes[size]) ++size;
      if (size >= largest_cluster) {
        large_cluster(number, size - largest_cluster, deltas, keep_clusters);
      } else {
        leave(number, static_cast<int>(size) + 1, keep_clusters);
      }
    }
  }

  void large_cluster(std::uint32_t number, std::size_t range, bool deltas, bool keep) {
    const Block words = stream_.block(Purpose::ionization, place_of_clusters_, cluster_blocks + number);
    const double most = collisions_.largest / matter_.w_value;
    const double low = std::min(matter_.tail[range], most), high = std::min(matter_.tail[range + 1], most);
    const int size =
        static_cast<int>(std::lround(1 / (1 / low - open_unit(words[0]) * (1 / low - 1 / high))));
    if (!deltas) return leave(number, size, keep);
    follow(gas_point(open_unit(words[1])), size * matter_.w_value, open_unit(words[2]), DeltaOrigin::gas);
  }

  void leave(std::uint32_t number, int size, bool keep) {
    clusters_ += size;
    if (!keep) return;
    const double part =
        open_unit(stream_.block(Purpose::ionization, place_of_clusters_, cluster_blocks + number)[1]);
    const HelixPoint &a = crossing_.entry, &b = crossing_.exit;
    out_.push_back({a.x + part * (b.x - a.x), a.y + part * (b.y - a.y), a.z + part * (b.z - a.z), 0, 0, 0,
                    size * matter_.w_value, size, 0, DeltaOrigin::gas});
  }

  void fast_electrons(double uniform) {
    const double least = matter_.tail.back() * matter_.w_value;
    const double rate = matter_.xi * crossing_.length * collisions_.particle.charge2_per_beta2 / least;
    const int n = std::min(poisson(uniform, rate * collisions_.peak), most_fast);
    for (std::uint32_t i = 0; i < static_cast<std::uint32_t>(n); ++i) {
      const Block words = stream_.block(Purpose::ionization, place_, fast_blocks + i);
      const double energy = least / open_unit(words[0]);
      if (open_unit(words[3]) * collisions_.peak > collisions_.share(energy)) continue;
      follow(gas_point(open_unit(words[1])), energy, open_unit(words[2]), DeltaOrigin::gas);
    }
  }

  void follow(const Start& from, double energy, double turns, DeltaOrigin origin) {
    Electron electron{0, from.w, from.z, from.du, from.dw, from.dz, energy};
    const auto [sine, cosine] = sine_cosine_of_turn(turns);
    deflect(electron, 0.5 * (1 - collisions_.cosine(energy)), cosine, sine);
    // Ten bits of `place` distinguish the electrons of a crossing.
    const std::uint32_t own = place_ | ((++followed_ & 1023U) << 16);
    electrons_.electrons.push_back({&matter_, crossing_.bz, stream_, own, electron});
    electrons_.births.push_back({from.cosine, from.sine, origin});
  }

  const GapMatter& matter_;
  const GapCrossing& crossing_;
  Collisions collisions_;
  const Stream& stream_;
  std::uint32_t place_, place_of_clusters_ = 0, followed_ = 0;
  DeltaBatch& electrons_;
  std::vector<Deposit>& out_;
  int clusters_ = 0;  // electrons set free
};

// A point in the electron's plane, mapped back onto the layer.
std::array<double, 3> rolled(const std::array<double, 3>& at, double inner, const DeltaBatch::Birth& birth) {
  const double r = inner + at[1], half = 0.5 * at[0] / r, t = half * tangent_over(half),
               scale = r / (1 + t * t);
  const double along = scale * (1 - t * t), across = scale * 2 * t;
  return {along * birth.cosine - across * birth.sine, along * birth.sine + across * birth.cosine, at[2]};
}

Deposit deposit_of(const Piece& piece, double inner, const DeltaBatch::Birth& birth) {
  const auto a = rolled(piece.from, inner, birth), b = rolled(piece.to, inner, birth);
  return {0.5 * (a[0] + b[0]),
          0.5 * (a[1] + b[1]),
          0.5 * (a[2] + b[2]),
          b[0] - a[0],
          b[1] - a[1],
          b[2] - a[2],
          piece.energy,
          0,
          0,
          birth.origin};
}

// Ionizations per mm by a particle of unit charge.
double cluster_density(const GapMatter& matter, double log_bg) {
  const GridPlace at(log_bg);
  return matter.clusters[at.i] +
         std::clamp(at.fraction, 0.0, 1.0) * (matter.clusters[at.i + 1] - matter.clusters[at.i]);
}

}  // namespace

Ionized set_free(const GapMatter& matter, const GapCrossing& crossing, const Kinematics& k,
                 const Stream& stream, std::uint32_t place, bool deltas, bool keep_clusters,
                 DeltaBatch& electrons, std::vector<Deposit>& out) {
  const std::size_t first = electrons.electrons.size();
  GapIonization ionization(matter, crossing, k, stream, place, electrons, out);
  ionization.gas(cluster_density(matter, k.log_bg) * k.charge2, deltas, keep_clusters);
  if (deltas) ionization.solids();
  return {ionization.clusters(), first, electrons.electrons.size()};
}

GapResult collect(const GapMatter& matter, const GapCrossing& crossing, const Ionized& ionized,
                  const DeltaBatch& electrons, std::vector<Deposit>& out) {
  GapResult result{ionized.clusters * matter.w_value, ionized.clusters, 0};
  const double inner = crossing.entry.radius();
  for (std::size_t i = ionized.first; i < ionized.last; ++i) {
    const ElectronTask& electron = electrons.electrons[i];
    if (electron.first == 0) continue;
    ++result.deltas;
    double sum = 0;
    int before = 0;
    for (std::size_t n = electron.first; n != 0; n = electrons.pieces[n].next) {
      Deposit deposit = deposit_of(electrons.pieces[n], inner, electrons.births[i]);
      sum += deposit.energy;
      const int so_far = static_cast<int>(std::lround(sum / matter.w_value));
      deposit.electrons = so_far - before;
      deposit.delta = result.deltas;
      before = so_far;
      out.push_back(deposit);
    }
    result.energy += sum;
    result.electrons += before;
  }
  return result;
}

GapResult ionize(const GapMatter& matter, const GapCrossing& crossing, const Kinematics& k,
                 const Stream& stream, std::uint32_t place, bool deltas, bool keep_clusters,
                 std::vector<Deposit>& out) {
  DeltaBatch electrons;
  const Ionized ionized = set_free(matter, crossing, k, stream, place, deltas, keep_clusters, electrons, out);
  follow(electrons);
  return collect(matter, crossing, ionized, electrons, out);
}

}  // namespace cgemit

#include "matter/ionization.hpp"

#include <algorithm>
#include <cmath>

#include "matter/draws.hpp"
#include "matter/electrons.hpp"
#include "matter/loss.hpp"
#include "matter/track.hpp"

namespace cgemit {

namespace {

// Blocks of random numbers. Of the gas: 0 for counts, then sizes (four a block), then one for each cluster
// and one for each fast electron. Of the solids: 0 for the count, then two for each electron.
constexpr std::uint32_t cluster_blocks = 512, fast_blocks = 3072, spin_blocks = 2048;
constexpr int most_clusters = 2044, most_fast = 1023, most_solid = 2047;
constexpr double steepest =
    0.05;  // cosine to the radius from which on the plane of the layer is no longer one

// What collisions of the particle with free electrons can do; keV.
struct Collisions {
  const Kinematics& particle;
  double largest;    // transfer
  double kinematic;  // the same, where the two electrons of a collision can be told apart
  double peak;       // of `share`

  explicit Collisions(const Kinematics& k)
      : particle(k),
        largest(k.w_max() / keV),
        kinematic(k.is_light() ? k.kinetic() / keV : largest),
        peak(spectrum_peak(k)) {}

  // How often there is one of this energy, relative to xi/(beta^2 E^2).
  double share(double energy) const {
    return energy > largest ? 0 : spectrum_share(particle, energy * keV, largest * keV);
  }
  // Cosine of the angle between particle and struck electron, by energy and momentum conservation.
  double cosine(double energy) const {
    constexpr double twice_rest = 2 * electron_mass / keV;
    return std::sqrt(std::min(energy * (kinematic + twice_rest) / (kinematic * (energy + twice_rest)), 1.0));
  }
};

class Passage {
 public:
  Passage(const GapMatter& matter, const GapCrossing& crossing, const Kinematics& k, const Stream& stream,
          std::uint32_t place, std::vector<Deposit>& out)
      : matter_(matter), crossing_(crossing), collisions_(k), stream_(stream), place_(place), out_(out) {}

  // Clusters of the size table, and the electrons above it.
  void gas(double density, bool deltas, bool keep_clusters) {
    const Block counts = stream_.block(Purpose::ionization, place_);
    const int n = std::min(poisson(open_unit(counts[0]), density * crossing_.length), most_clusters);
    Block words{};
    for (int i = 0; i < n; ++i) {
      const auto number = static_cast<std::uint32_t>(i);
      if (number % 4 == 0) words = stream_.block(Purpose::ionization, place_, 1 + number / 4);
      std::size_t size = 0;
      while (size + 1 < matter_.sizes.size() && words[number % 4] >= matter_.sizes[size]) ++size;
      if (size >= largest_cluster) {
        large_cluster(number, size - largest_cluster, deltas, keep_clusters);
      } else {
        leave(number, static_cast<int>(size) + 1, keep_clusters);
      }
    }
    if (deltas) fast_electrons(open_unit(counts[1]));
  }

  // Electrons from the cathode and from behind the gap.
  void solids() {
    const Block count = stream_.block(Purpose::deltas, place_);
    const auto& slices = matter_.slices;
    if (slices.empty()) return;
    const double total = slices.back().rate;
    const double expected =
        total * collisions_.peak * collisions_.particle.per_beta2 * crossing_.length / matter_.width();
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

  GapResult result() const {
    return {energy_ + clusters_ * matter_.w_value, clusters_ + delta_electrons_, deltas_};
  }

 private:
  // A point of the track and how it flies there, in the plane that touches the layer: u along r phi.
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
    const double outward = std::max(edge.outward() / edge.radius(), steepest);
    const double arc = (w < 0 ? w : w - matter_.width()) / outward;
    return start(edge, edge.x + arc * edge.ux, edge.y + arc * edge.uy, edge.z + arc * edge.tanl, w);
  }

  void large_cluster(std::uint32_t number, std::size_t range, bool deltas, bool keep) {
    const Block words = stream_.block(Purpose::ionization, place_, cluster_blocks + number);
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
    const double part = open_unit(stream_.block(Purpose::ionization, place_, cluster_blocks + number)[1]);
    const HelixPoint &a = crossing_.entry, &b = crossing_.exit;
    out_.push_back({a.x + part * (b.x - a.x), a.y + part * (b.y - a.y), a.z + part * (b.z - a.z), 0, 0, 0,
                    size * matter_.w_value, size, 0, DeltaOrigin::gas});
  }

  void fast_electrons(double uniform) {
    const double least = matter_.tail.back() * matter_.w_value;
    const double rate = matter_.xi * crossing_.length * collisions_.particle.per_beta2 / least;
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
    const double azimuth = 2 * pi * turns;
    deflect(electron, 0.5 * (1 - collisions_.cosine(energy)), std::cos(azimuth), std::sin(azimuth));
    pieces_.clear();
    // Ten bits of the place tell the electrons of a crossing apart.
    const std::uint32_t own = place_ | ((++followed_ & 1023U) << 16);
    transport(matter_, electron, crossing_.bz, stream_, own, pieces_);
    if (pieces_.empty()) return;
    ++deltas_;
    double sum = 0;
    int before = 0;
    for (const Piece& piece : pieces_) {
      sum += piece.energy;
      const int electrons = static_cast<int>(std::lround(sum / matter_.w_value));
      record(from, piece, electrons - before, origin);
      before = electrons;
    }
    energy_ += sum;
    delta_electrons_ += before;
  }

  void record(const Start& from, const Piece& piece, int electrons, DeltaOrigin origin) {
    const double inner = crossing_.entry.radius();
    const auto place = [&from, inner](const std::array<double, 3>& p) {
      const double r = inner + p[1], half = 0.5 * p[0] / r, t = half * tangent_over(half),
                   scale = r / (1 + t * t);
      const double along = scale * (1 - t * t), across = scale * 2 * t;
      return std::array{along * from.cosine - across * from.sine, along * from.sine + across * from.cosine,
                        p[2]};
    };
    const auto a = place(piece.from), b = place(piece.to);
    out_.push_back({0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2]), b[0] - a[0], b[1] - a[1],
                    b[2] - a[2], piece.energy, electrons, deltas_, origin});
  }

  const GapMatter& matter_;
  const GapCrossing& crossing_;
  Collisions collisions_;
  const Stream& stream_;
  std::uint32_t place_, followed_ = 0;
  std::vector<Deposit>& out_;
  std::vector<Piece> pieces_;
  double energy_ = 0;                       // keV, of deltas
  int clusters_ = 0, delta_electrons_ = 0;  // electrons set free
  int deltas_ = 0;
};

// Ionizations per mm.
double cluster_density(const GapMatter& matter, double log_bg) {
  const GridPlace at(log_bg);
  return matter.clusters[at.i] +
         std::clamp(at.fraction, 0.0, 1.0) * (matter.clusters[at.i + 1] - matter.clusters[at.i]);
}

}  // namespace

GapResult ionize(const GapMatter& matter, const GapCrossing& crossing, const Kinematics& k,
                 const Stream& stream, std::uint32_t place, bool deltas, bool keep_clusters,
                 std::vector<Deposit>& out) {
  Passage passage(matter, crossing, k, stream, place, out);
  passage.gas(cluster_density(matter, k.log_bg), deltas, keep_clusters);
  if (deltas) passage.solids();
  return passage.result();
}

}  // namespace cgemit

// State of particles at their vertices, one per lane.
#pragma once

#include <array>
#include <cmath>

#include "matter/draws.hpp"
#include "matter/kinematics.hpp"
#include "simulation/transport/simulate.hpp"

namespace cgemit {

inline constexpr std::uint32_t inward_leg = 1U << 19;  // above any particle number

inline Stream stream_of(const ParticleColumns& in, std::size_t row, std::uint64_t seed,
                        std::uint32_t leg = 0) {
  return {seed, static_cast<std::uint64_t>(in.event[row]),
          static_cast<std::uint32_t>(in.particle[row]) | leg};
}

// Of a half turn. Number 0 is the first outward one, -1 the inward path before it. Later ones have the random
// numbers of an event of their own.
inline Stream stream_of_half_turn(const ParticleColumns& in, std::size_t row, std::uint64_t seed,
                                  int half_turn) {
  const Stream first = stream_of(in, row, seed, half_turn < 0 ? inward_leg : 0);
  if (half_turn <= 0) return first;
  const Block words = first.block(Purpose::half_turn, static_cast<std::uint32_t>(half_turn));
  return {seed, 1ULL << 63 | std::uint64_t{words[0]} << 32 | words[1],
          static_cast<std::uint32_t>(in.particle[row])};
}

// A table with one particle; it refers to the daughter. Its random numbers are those of an event of its own.
inline ParticleColumns columns_of(const Daughter& one) {
  const auto of = [](const auto& value) { return std::span(&value, 1); };
  return {.event = of(one.stream),
          .particle = of(one.of.particle),
          .pdg = of(one.pdg),
          .charge = of(one.charge),
          .mass = of(one.mass),
          .x = of(one.at.position.x),
          .y = of(one.at.position.y),
          .z = of(one.at.position.z),
          .px = of(one.momentum.x),
          .py = of(one.momentum.y),
          .pz = of(one.momentum.z),
          .decay_time = {}};
}

// Rows of the particles in the lanes; empty lanes repeat one of them.
template <class T>
struct StartOf {
  const ParticleColumns& in;
  std::array<std::size_t, static_cast<std::size_t>(lanes_of<T>)> rows;
  std::uint64_t seed;

  template <class F>
  T column(F&& f) const {
    return gathered<T>([&](int i) { return f(rows[static_cast<std::size_t>(i)]); });
  }

  StreamOf<T> streams(std::uint32_t leg) const {
    if constexpr (lanes_of<T> == 1) {
      return stream_of(in, rows[0], seed, leg);
    } else {
      return [&]<std::size_t... i>(std::index_sequence<i...>) {
        return StreamOf<T>({stream_of(in, rows[i], seed, leg)...});
      }(std::make_index_sequence<std::size_t{lanes_of<T>}>());
    }
  }

  KinematicsOf<T> kinematics() const {
    const auto kind = [this](std::size_t row) { return projectile_of(in.mass[row], in.charge[row]); };
    KinematicsOf<T> k(
        column([&](std::size_t row) { return std::hypot(in.px[row], in.py[row], in.pz[row]); }),
        {column([&](std::size_t row) { return in.mass[row]; }),
         column([&](std::size_t row) { return std::abs(double(in.charge[row])); }), kind(rows[0])});
    k.has_spin = column([&](std::size_t row) { return kind(row) == Projectile::spin_half ? 1.0 : 0.0; });
    return k;
  }

  // Time of the decay in ns if the particles keep their energy; infinite for those that do not decay. The
  // proper time is exponential, unless the particle brings its time of decay.
  T decay_time(const DecayTable* decays, const T& gamma) const {
    const T drawn = drawn_decay_time(decays, gamma);
    if (in.decay_time.empty()) return drawn;
    const T given = column([&](std::size_t row) { return in.decay_time[row]; });
    return select(given < HUGE_VAL, given, drawn);
  }

 private:
  T drawn_decay_time(const DecayTable* decays, const T& gamma) const {
    if (decays == nullptr) return T(HUGE_VAL);
    const T lifetime = column([&](std::size_t row) { return decays->lifetime(in.pdg[row]); });
    if (!any(lifetime < HUGE_VAL)) return lifetime;
    const StreamOf<T> stream = streams(0);
    DrawsOf<T> draws(stream, Purpose::decay, static_cast<std::uint32_t>(DecayDraw::lifetime));
    return -lifetime * gamma * log(draws.next());
  }
};

}  // namespace cgemit

#include "simulation/transport/decays.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "matter/draws.hpp"
#include "simulation/transport/daughters.hpp"

namespace cgemit {

namespace {

using Vector = Vec3<double>;

struct FourVector {
  Vector p;
  double energy;
};

// Momentum of the two products of a mass in its rest frame (PDG 2024, Kinematics).
double two_body_momentum(double mass, double one, double other) {
  const double sum = one + other, difference = one - other;
  const double square = (mass - sum) * (mass + sum) * (mass - difference) * (mass + difference);
  return std::sqrt(std::max(square, 0.0)) / (2 * mass);
}

Vector isotropic(Draws& draws) {
  const double cosine = 2 * draws.next() - 1, sine = std::sqrt(1 - cosine * cosine);
  const double azimuth = 2 * pi * draws.next();
  return {sine * std::cos(azimuth), sine * std::sin(azimuth), cosine};
}

// From the rest frame of a particle to the frame in which its velocity is `bg`/gamma.
FourVector boosted(const FourVector& one, const Vector& bg) {
  const double gamma = std::sqrt(1 + dot(bg, bg)), along = dot(bg, one.p);
  return {one.p + (along / (gamma + 1) + one.energy) * bg, gamma * one.energy + along};
}

std::array<FourVector, 2> two_bodies(double mass, double one, double other, Draws& draws) {
  const double p = two_body_momentum(mass, one, other);
  const Vector momentum = p * isotropic(draws);
  return {FourVector{momentum, std::sqrt(p * p + one * one)},
          FourVector{-1.0 * momentum, std::sqrt(p * p + other * other)}};
}

// Constant matrix element: the mass of the first two products is drawn with the density that is
// proportional to the product of the momenta of the two successive decays (PDG 2024, Kinematics).
std::array<FourVector, 3> three_bodies(double mass, const std::vector<DecayProduct>& products, Draws& draws) {
  const double a = products[0].mass, b = products[1].mass, c = products[2].mass;
  const double least = a + b, most = mass - c;
  const double bound = two_body_momentum(mass, least, c) * two_body_momentum(most, a, b);
  double pair = 0, weight = 0;
  do {
    pair = least + (most - least) * draws.next();
    weight = two_body_momentum(mass, pair, c) * two_body_momentum(pair, a, b);
  } while (draws.next() * bound > weight);
  const auto [together, third] = two_bodies(mass, pair, c, draws);
  const auto [first, second] = two_bodies(pair, a, b, draws);
  const Vector bg = (1 / pair) * together.p;
  return {boosted(first, bg), boosted(second, bg), third};
}

// Density of K -> pi l nu in the energies of the products, relative to phase space: PDG, "Kl3 form factors",
// with f+ constant and f- = 0.
double semileptonic_density(double mass, const std::vector<DecayProduct>& products,
                            const std::array<FourVector, 3>& p) {
  const double pion = products[0].mass, lepton = products[1].mass;
  const double highest = (mass * mass + pion * pion - lepton * lepton) / (2 * mass);
  const double missing = highest - p[0].energy;
  return mass * (2 * p[1].energy * p[2].energy - mass * missing) +
         lepton * lepton * (0.25 * missing - p[2].energy);
}

std::array<FourVector, 3> semileptonic(double mass, const std::vector<DecayProduct>& products, Draws& draws) {
  const double free = mass - products[0].mass, bound = 0.5 * mass * free * free;
  for (;;) {
    const std::array<FourVector, 3> p = three_bodies(mass, products, draws);
    if (draws.next() * bound < semileptonic_density(mass, products, p)) return p;
  }
}

// The electron of a muon decay: x^2 (3 - 2 x) in the energy x over the largest (PDG 2024, Muon
// decay parameters, rho = 3/4). The neutrinos share what is left in opposite directions: nothing depends on
// them.
FourVector michel_electron(double mass, double lepton, Draws& draws) {
  const double highest = (mass * mass + lepton * lepton) / (2 * mass);
  double x = 0;
  do {
    x = draws.next();
  } while (draws.next() > x * x * (3 - 2 * x) || x * highest <= lepton);
  const double energy = x * highest;
  return {std::sqrt(energy * energy - lepton * lepton) * isotropic(draws), energy};
}

std::vector<FourVector> at_rest(double mass, const DecayMode& mode, Draws& draws) {
  const auto& products = mode.products;
  if (mode.spectrum == DecaySpectrum::michel) return {michel_electron(mass, products[0].mass, draws)};
  if (mode.spectrum == DecaySpectrum::semileptonic) {
    const auto p = semileptonic(mass, products, draws);
    return {p.begin(), p.end()};
  }
  if (products.size() == 3) {
    const auto p = three_bodies(mass, products, draws);
    return {p.begin(), p.end()};
  }
  const auto p = two_bodies(mass, products[0].mass, products[1].mass, draws);
  return {p.begin(), p.end()};
}

std::size_t choose_mode(const std::vector<DecayMode>& modes, double u) {
  std::size_t chosen = 0;
  for (double sum = modes[0].fraction; u > sum && chosen + 1 < modes.size();) sum += modes[++chosen].fraction;
  return chosen;
}

}  // namespace

DecayProducts decay(const UnstableSpecies& species, const DecayPoint& at, const Stream& stream) {
  Draws draws(stream, Purpose::decay, static_cast<std::uint32_t>(DecayDraw::products));
  const std::size_t chosen = choose_mode(species.modes, draws.next());
  DecayProducts result{chosen, &species.modes[chosen].products, {}};
  const Vector bg = (1 / at.mass) * at.momentum;
  for (const FourVector& one : at_rest(species.mass, species.modes[chosen], draws))
    result.momenta.push_back(boosted(one, bg).p);
  return result;
}

void add_daughters(const UnstableSpecies& species, const DecayPoint& at, const Stream& stream,
                   const ParticleNumber& of, std::int32_t parent, double start, std::vector<Daughter>& out) {
  const DecayProducts drawn = decay(species, at, stream);
  for (std::uint32_t k = 0; k < drawn.momenta.size(); ++k) {
    const DecayProduct& product = (*drawn.products)[k];
    if (product.charge == 0) continue;
    const Block words = stream.block(Purpose::decay, static_cast<std::uint32_t>(DecayDraw::streams), k);
    out.push_back({.of = of,
                   .parent = parent,
                   .pdg = product.pdg,
                   .mode = static_cast<std::int32_t>(drawn.mode),
                   .charge = static_cast<std::int8_t>(product.charge),
                   .mass = product.mass,
                   .at = at,
                   .momentum = drawn.momenta[k],
                   .time = start + at.time,
                   .stream = static_cast<std::int64_t>(1ULL << 63 | std::uint64_t{words[0]} << 32 | words[1]),
                   .status = TransportStatus::outside});
  }
}

}  // namespace cgemit

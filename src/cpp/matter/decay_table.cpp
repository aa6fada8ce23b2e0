#include "matter/decay_table.hpp"

#include <stdexcept>
#include <string>

namespace cgemit {

void check(const UnstableSpecies& species) {
  const auto fail = [&species](const std::string& problem) {
    throw std::invalid_argument("decays of " + std::to_string(species.pdg) + ": " + problem);
  };
  if (!(species.mass > 0 && species.lifetime > 0)) fail("expected mass and lifetime above 0");
  double fractions = 0;
  for (const DecayMode& mode : species.modes) {
    double masses = 0;
    for (const DecayProduct& product : mode.products) masses += product.mass;
    const std::size_t n = mode.products.size();
    if (n != 3 && (n != 2 || mode.spectrum != DecaySpectrum::phase_space))
      fail("got " + std::to_string(n) + " products, expected 3, or 2 by phase space");
    if (mode.spectrum == DecaySpectrum::michel &&
        (mode.products[1].charge != 0 || mode.products[2].charge != 0))
      fail("expected neutral products after the lepton");
    if (!(masses < species.mass)) fail("the products are heavier than the particle");
    if (!(mode.fraction > 0)) fail("expected fractions above 0");
    fractions += mode.fraction;
  }
  if (!(std::abs(fractions - 1) < 1e-9)) fail("expected fractions with the sum 1");
}

}  // namespace cgemit

#include "detector/shells.hpp"

#include <algorithm>
#include <cmath>

namespace cgemit {

namespace {

// Adds the components of a shell to those of the same elements.
void add_components(const Material& material, double width, ShellSums& sums,
                    std::vector<std::int64_t>& elements) {
  for (std::size_t i = 0; i < material.components.size(); ++i) {
    const Component& one = material.components[i];
    const auto known = std::ranges::find(elements, material.elements[i]) - elements.begin();
    if (known < std::ssize(elements)) {
      sums.components[static_cast<std::size_t>(known)].moles += one.moles * width;
    } else {
      elements.push_back(material.elements[i]);
      sums.components.push_back({one.z, one.a, one.moles * width});
    }
  }
}

}  // namespace

ShellSums sum_shells(std::span<const MaterialShell> shells) {
  ShellSums sums{0, 0, 0, 0, std::vector<double>(loss_points), {}};
  std::vector<std::int64_t> elements;
  for (const MaterialShell& shell : shells) {
    const Material& material = *shell.material;
    const double width = shell.r_out - shell.r_in, x0 = width / material.x0, xi = material.xi * width;
    sums.x0 += x0;
    sums.xi += xi;
    sums.radius += x0 * (0.5 * (shell.r_in + shell.r_out));
    for (std::size_t k = 0; k < sums.log_terms.size(); ++k) sums.log_terms[k] += material.log_term[k] * xi;
    add_components(material, width, sums, elements);
  }
  sums.radius /= sums.x0;
  for (const MaterialShell& shell : shells) {
    const double width = shell.r_out - shell.r_in, off = 0.5 * (shell.r_in + shell.r_out) - sums.radius;
    sums.spread += width / shell.material->x0 * (off * off + width * width / 12);
  }
  sums.spread = std::sqrt(sums.spread / sums.x0);
  for (double& term : sums.log_terms) term /= sums.xi;
  return sums;
}

}  // namespace cgemit

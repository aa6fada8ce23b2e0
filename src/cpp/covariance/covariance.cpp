#include "covariance/covariance.hpp"

#include <algorithm>

#include "common/lanes/number.hpp"
#include "covariance/batch.hpp"

namespace cgemit {

bool same_surfaces(const Detector& a, const Detector& b) {
  return a.layers.size() == b.layers.size() && a.field.is_uniform() == b.field.is_uniform() &&
         std::ranges::equal(a.surfaces, b.surfaces, [](const Surface& one, const Surface& other) {
           return one.is_slab == other.is_slab && one.index == other.index;
         });
}

void covariances(const Detector& detector, const CovarianceInput& input, const HitModel& model,
                 const CovarianceOutput& output) {
  CovarianceBatch<Number>(detector, input, model, output).run();
}

}  // namespace cgemit

#include "covariance/covariance.hpp"

#include "covariance/batch.hpp"

namespace cgemit {

void covariances(const Detector& detector, const CovarianceInput& input, const CovarianceSettings& settings,
                 const CovarianceOutput& output) {
  CovarianceBatch<double>(detector, input, settings, output).run();
}

}  // namespace cgemit

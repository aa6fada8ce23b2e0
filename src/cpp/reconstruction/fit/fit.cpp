#include "reconstruction/fit/fit.hpp"

#include "common/lanes/number.hpp"
#include "reconstruction/fit/batch.hpp"

namespace cgemit {

void fit_tracks(const Detector& detector, const FitInput& input, const FitSettings& settings,
                const FitOutput& output) {
  BatchFit<Number>(detector, input, settings, output).run();
}

}  // namespace cgemit

#include "reconstruction/fit/fit.hpp"

#include "reconstruction/fit/batch.hpp"

namespace cgemit {

void fit_tracks(const Detector& detector, const FitInput& input, const FitSettings& settings,
                const FitOutput& output) {
  BatchFit<double>(detector, input, settings, output).run();
}

}  // namespace cgemit

#include "calibration/sums.hpp"

#include "calibration/batch.hpp"
#include "common/lanes/number.hpp"

namespace cgemit {

void alignment_sums(const Detector& detector, const FittedTracks& tracks, const ColumnMap& map,
                    const SumsOutput& output) {
  SumsBatch<Number>(detector, tracks, map, output).run();
}

}  // namespace cgemit

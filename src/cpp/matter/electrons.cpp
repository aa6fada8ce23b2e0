#include "matter/electrons.hpp"

#include "matter/electron_flight.hpp"

namespace cgemit {

void follow(ElectronBatch& batch) { ElectronFlight<double>(batch).run(); }

}  // namespace cgemit

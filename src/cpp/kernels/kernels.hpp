// The stages that run on lanes, for the instruction set in use.
//
// Every instruction set has a shared library of its own, so that one build never calls an inline function of
// another: two instantiations of a template have the same name, and a linker would keep either. The library
// is opened at run time if the processor has the instructions. `scalar` is part of the core itself.
#pragma once

#include <string>

#include "calibration/sums.hpp"
#include "covariance/covariance.hpp"
#include "reconstruction/fit/fit.hpp"
#include "simulation/digitize/analog.hpp"
#include "simulation/digitize/wires.hpp"
#include "simulation/transport/simulate.hpp"

namespace cgemit {

struct Kernels {
  const char* isa;
  int lanes;
  // Applies a function of `common/lanes/math.hpp` to n numbers, n a multiple of the lanes: for tests.
  void (*function)(const std::string& name, const double* in, double* out, std::size_t n);
  void (*simulate)(const Detector&, const ParticleColumns&, const SimulateSettings&, std::uint64_t seed,
                   Simulated&);
  void (*fit)(const Detector&, const FitInput&, const FitSettings&, const FitOutput&);
  void (*covariances)(const Detector&, const CovarianceInput&, const HitModel&, const CovarianceOutput&);
  void (*alignment_sums)(const Detector&, const FittedTracks&, const ColumnMap&, const SumsOutput&);
  void (*read_out_analog)(const Detector&, const TruthColumns&, const StepColumns&, const AnalogModel&,
                          const GainMaps&, Columns<DigiRow>&);
  Columns<WireHitRow> (*read_out_wires)(const Detector&, const WireTruthColumns&, const WireReadout&);
};

// The kernels in use: scalar ones until others are opened.
const Kernels& kernels();

// The reference, whichever are in use: what is made with it is the same to the last bit.
const Kernels& scalar_kernels();

// Whether this processor can run code for "scalar", "baseline", "v3" (AVX2, FMA) or "v4" (AVX-512).
bool processor_runs(const std::string& isa);

// Opens the library at a path. Throws std::runtime_error if it is not a kernel library of this package.
void use_kernels(const std::string& path);
void use_scalar_kernels();

}  // namespace cgemit

// The stages that run on lanes, for the instruction set in use.
//
// Every instruction set has a shared library of its own, so that no inline function of one build is ever
// called by another: the same template instantiated twice has one name, and a linker would keep either. It is
// opened at run time where the processor has what it needs. `scalar` is part of the core itself.
#pragma once

#include <string>

#include "fit/fit.hpp"
#include "simulate/simulate.hpp"

namespace cgemit {

struct Kernels {
  const char* isa;
  int lanes;
  // A function of `lanes/math.hpp` on n numbers, n a multiple of the lanes: for tests.
  void (*function)(const std::string& name, const double* in, double* out, std::size_t n);
  void (*simulate)(const Detector&, const ParticleColumns&, const SimulateSettings&, std::uint64_t seed,
                   Simulated&);
  void (*fit)(const Detector&, const FitInput&, const FitSettings&, const FitOutput&);
};

// Those in use: scalar ones until others are opened.
const Kernels& kernels();

// Whether this processor runs code for "scalar", "baseline", "v3" (AVX2, FMA) or "v4" (AVX-512).
bool processor_runs(const std::string& isa);

// Opens the library at a path. Throws std::runtime_error if that is not one of ours.
void use_kernels(const std::string& path);
void use_scalar_kernels();

}  // namespace cgemit

#include "kernels/kernels.hpp"

#include <atomic>
#include <stdexcept>

#include "kernels/testing.hpp"

#if !defined(_WIN32)
#include <dlfcn.h>
#endif

namespace cgemit {

namespace {

constexpr Kernels scalar{"scalar",
                         1,
                         &function_of_lanes<double>,
                         &simulate,
                         &fit_tracks,
                         &covariances,
                         &alignment_sums,
                         &read_out_analog,
                         &read_out_wires};
std::atomic<const Kernels*> in_use{&scalar};

}  // namespace

const Kernels& kernels() { return *in_use.load(); }
const Kernels& scalar_kernels() { return scalar; }

bool processor_runs(const std::string& isa) {
  if (isa == "scalar" || isa == "baseline") return true;
#if defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
  __builtin_cpu_init();
  // The other features of x86-64-v3 (LZCNT, MOVBE, F16C) came with the same processors.
  const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                  __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2");
  if (isa == "v3") return v3;
  if (isa == "v4")
    return v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512vl");
#endif
  return false;
}

void use_scalar_kernels() { in_use = &scalar; }

#if !defined(_WIN32)
void use_kernels(const std::string& path) {
  // Never closed: threads may still be executing it.
  void* library = dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
  if (library == nullptr) throw std::runtime_error(dlerror());
  using Entry = const Kernels* (*)();
  const auto entry = reinterpret_cast<Entry>(dlsym(library, "cgemit_kernels"));
  if (entry == nullptr) throw std::runtime_error(path + ": no library of kernels");
  in_use = entry();
}
#else
void use_kernels(const std::string& path) { throw std::runtime_error(path + ": no kernels on this system"); }
#endif

}  // namespace cgemit

// Compiler-dependent code. The rest of the core is standard C++20, except for the vector types of `lanes`,
// which are enabled by CGEMIT_VECTORS, and the instructions of single processors used there, which are
// enabled by the macros of each instruction set.
#pragma once

// Vector types of the compiler, W numbers in one register. Without them kernels exist for `double` only.
#if !defined(CGEMIT_VECTORS)
#if defined(__GNUC__) || defined(__clang__)
#define CGEMIT_VECTORS 1
#else
#define CGEMIT_VECTORS 0
#endif
#endif

// CGEMIT_FLATTEN: all calls of the function are inlined into it, and such functions lie side by side. A build
// may define it as empty (CMakeLists.txt does for the sanitizers). CGEMIT_NOINLINE: the function is never
// inlined. CGEMIT_EXPORT: visible outside the library.
#if defined(__GNUC__) || defined(__clang__)
#if !defined(CGEMIT_FLATTEN)
#define CGEMIT_FLATTEN [[gnu::flatten, gnu::hot]]
#endif
#define CGEMIT_NOINLINE [[gnu::noinline]]
#define CGEMIT_EXPORT [[gnu::visibility("default")]]
#else
#if !defined(CGEMIT_FLATTEN)
#define CGEMIT_FLATTEN
#endif
#define CGEMIT_NOINLINE
#define CGEMIT_EXPORT
#endif

namespace cgemit {

// Prefetches the cache line of an address for reading.
inline void prefetch([[maybe_unused]] const void* address) {
#if defined(__GNUC__) || defined(__clang__)
  __builtin_prefetch(address);
#endif
}

}  // namespace cgemit

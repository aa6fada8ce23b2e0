// What compilers spell differently. The rest of the core is standard C++20, but for the vector types of
// `lanes`, which stand behind CGEMIT_VECTORS, and there the instructions of single processors, behind the
// macros that announce them.
#pragma once

// Vector types of the compiler, W numbers in one register: without them kernels exist for `double` only.
#if !defined(CGEMIT_VECTORS)
#if defined(__GNUC__) || defined(__clang__)
#define CGEMIT_VECTORS 1
#else
#define CGEMIT_VECTORS 0
#endif
#endif

// CGEMIT_FLATTEN: everything that the function calls is inlined into it. A build may define it as empty
// (CMakeLists.txt does for the sanitizers). CGEMIT_NOINLINE: the function is never inlined.
// CGEMIT_EXPORT: visible outside the library.
#if defined(__GNUC__) || defined(__clang__)
#if !defined(CGEMIT_FLATTEN)
#define CGEMIT_FLATTEN [[gnu::flatten]]
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

// Asks for the line of the cache that holds an address, to be read soon.
inline void prefetch([[maybe_unused]] const void* address) {
#if defined(__GNUC__) || defined(__clang__)
  __builtin_prefetch(address);
#endif
}

}  // namespace cgemit

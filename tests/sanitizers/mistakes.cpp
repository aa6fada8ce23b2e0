// Mistakes on purpose, built and called by `.ci/sanitize`: each has to be reported, else the sanitizer
// watches nothing.
#include <limits>
#include <vector>

extern "C" {

double beyond_the_end(int n) {
  const std::vector<double> values(static_cast<unsigned>(n), 1.0);
  return values.data()[n];
}

int overflow(int n) { return std::numeric_limits<int>::max() + n; }

// Read before it is written.
int undefined(int n) {
  bool values[8];
  for (int i = n; i < 8; ++i) values[i] = true;
  return values[0];
}

// From two threads with the same counter.
void race(int* counter) {
  for (int i = 0; i < 20000000; ++i) ++*const_cast<volatile int*>(counter);
}

// The caller forgets what it gets.
double* leak(int n) { return new double[static_cast<unsigned>(n)]; }

}  // extern "C"

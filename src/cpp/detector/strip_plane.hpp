// Local coordinates on the unrolled readout of a CGEM layer, in mm:
//   X = r_readout (phi - phi_first[sheet])            along the circumference, from 0 to sheet_width()
//   V = X cos(stereo) + (z_ref - z) sin(stereo)       across the stereo strips, from 0 upwards
// X strip i covers X from i to i + 1 pitches, V strip i covers V from i + offset_v to i + 1 + offset_v
// pitches, as the experiment's software counts them for both signs of the stereo angle (docs/conventions.md).
#pragma once

#include "common/angles.hpp"
#include "detector/detector.hpp"

namespace cgemit {

// X of an azimuth, counted from the edge of a sheet: in [0, 2 pi r_readout); values above sheet_width() are
// off the sheet.
inline double local_x(const MeasuringLayer& layer, int sheet, double phi) {
  return layer.r_readout * positive_angle(phi - layer.phi_first[sheet]);
}

// Azimuth in (-pi, pi] of an X on a sheet.
inline double azimuth(const MeasuringLayer& layer, int sheet, double x) {
  return wrap_angle(layer.phi_first[sheet] + x / layer.r_readout);
}

inline double local_v(const MeasuringLayer& layer, double x, double z) {
  return x * layer.cos_stereo + (layer.z_ref() - z) * layer.sin_stereo;
}

// Positions counted in strips: i at the edge where strip i begins, i + 1/2 at its middle.
inline double strips_of_x(const MeasuringLayer& layer, double x) { return x / layer.pitch_x; }
inline double strips_of_v(const MeasuringLayer& layer, double v) {
  return v / layer.pitch_v - layer.offset_v;
}
inline double x_of_strips(const MeasuringLayer& layer, double strips) { return strips * layer.pitch_x; }
inline double v_of_strips(const MeasuringLayer& layer, double strips) {
  return (strips + layer.offset_v) * layer.pitch_v;
}

// z at which the line of constant V crosses the line of constant X.
inline double crossing_z(const MeasuringLayer& layer, double x, double v) {
  return layer.z_ref() - (v - x * layer.cos_stereo) / layer.sin_stereo;
}

}  // namespace cgemit

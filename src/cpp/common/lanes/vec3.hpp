// Vectors in space of any number type.
#pragma once

#include "common/lanes/pack.hpp"

namespace cgemit {

template <class T>
struct Vec3 {
  T x, y, z;

  friend Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
  friend Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
  friend Vec3 operator*(const T& a, const Vec3& b) { return {a * b.x, a * b.y, a * b.z}; }
};

template <class T>
T dot(const Vec3<T>& a, const Vec3<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class T>
Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
Vec3<T> select(const mask_of<T>& m, const Vec3<T>& a, const Vec3<T>& b) {
  return {select(m, a.x, b.x), select(m, a.y, b.y), select(m, a.z, b.z)};
}

// Three rows.
template <class T>
struct Mat3 {
  Vec3<T> x, y, z;

  friend Mat3 operator*(const T& a, const Mat3& m) { return {a * m.x, a * m.y, a * m.z}; }
  friend Vec3<T> operator*(const Mat3& m, const Vec3<T>& v) {
    return {dot(m.x, v), dot(m.y, v), dot(m.z, v)};
  }
  friend Mat3 operator+(const Mat3& a, const Mat3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
};
template <class T>
Mat3<T> select(const mask_of<T>& m, const Mat3<T>& a, const Mat3<T>& b) {
  return {select<T>(m, a.x, b.x), select<T>(m, a.y, b.y), select<T>(m, a.z, b.z)};
}

}  // namespace cgemit

// Leaves out hits that do not belong to their track, and takes them back if the track moves closer.
#pragma once

#include "kalman/group.hpp"

namespace cgemit {

template <class T>
T squared_pull(const Slot<T>& slot) {
  return slot.unbiased * slot.unbiased / slot.unbiased_variance;
}

// The largest squared pull of a hit that is used.
template <class T>
T worst_pull(const Group<T>& group) {
  T worst(0.0);
  for (const Slot<T>& slot : group.slots)
    worst = larger(worst, select(slot.used, squared_pull(slot), T(0.0)));
  return worst;
}

// Leaves out the hits with large pulls to the rest of the track, the worst first, and takes back those whose
// pull is small again. True where nothing changed.
template <class T>
mask_of<T> renew_outliers(Group<T>& group, mask_of<T> who, double most_pull, bool may_return) {
  T left(0.0);
  const T worst = worst_pull(group);
  mask_of<T> some(false);
  for (const Slot<T>& slot : group.slots) {
    left += select(slot.used, T(1.0), T(0.0));
    some = some | slot.outlier;
  }
  const double cut = most_pull * most_pull;
  if (!any(who & (some | (worst > cut)))) return mask_of<T>(true);
  // Far outliers move the track away from its good hits, so the worst ones are removed first.
  const T limit = larger(0.25 * worst, cut);
  mask_of<T> changed(false);
  for (Slot<T>& slot : group.slots) {
    const T pull = squared_pull(slot);
    const mask_of<T> out = who & slot.used & (pull > limit) & (left > parameters + 1.0);
    mask_of<T> back = who & slot.met & slot.outlier & (pull < cut);
    if (!may_return) back = mask_of<T>(false);
    left -= select(out, T(1.0), T(0.0));
    slot.outlier = (slot.outlier | out) & !back;
    changed = changed | out | back;
  }
  return !changed;
}

// If a new reference meets so few hits that no more are left than parameters, the outliers are used again.
template <class T>
void keep_enough(Group<T>& group, mask_of<T> who) {
  T used(0.0);
  for (const Slot<T>& slot : group.slots) used += select(slot.met & !slot.outlier, T(1.0), T(0.0));
  const mask_of<T> few = who & (used <= double(parameters));
  if (!any(few)) return;
  for (Slot<T>& slot : group.slots) slot.outlier = slot.outlier & !few;
}

}  // namespace cgemit

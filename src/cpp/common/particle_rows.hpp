// Rows that name a particle by its number in an event.
#pragma once

#include <cstdint>
#include <span>
#include <tuple>
#include <vector>

#include "common/columns.hpp"

namespace cgemit {

// Rows by event, each with the number of a particle in its event.
struct NumberedRows {
  std::span<const std::int64_t> event;
  std::span<const std::int32_t> particle;

  static constexpr auto columns() {
    return std::tuple(Column("event", &NumberedRows::event), Column("particle", &NumberedRows::particle));
  }
};

// Row of the particle that each row names; -1 none.
std::vector<std::int64_t> particle_rows(const NumberedRows& particles, const NumberedRows& rows);

}  // namespace cgemit

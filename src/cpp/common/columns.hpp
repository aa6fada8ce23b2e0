// Tables as one vector per column. A struct `Row` names its columns once, in order:
//   static constexpr auto columns() { return std::tuple(Column("event", &Row::event), ...); }
// A field that is an array is one column of rows. A field that is a struct with columns has those, whose
// names follow its own.
#pragma once

#include <cstddef>
#include <cstring>
#include <span>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "common/compiler.hpp"

namespace cgemit {

template <class Row, class Value>
struct Column {
  const char* name;
  Value Row::* value;

  constexpr Column(const char* of_table, Value Row::* of_row) : name(of_table), value(of_row) {}

  // Enums are kept as their numbers.
  static auto entry() {
    if constexpr (std::is_enum_v<Value>)
      return std::underlying_type_t<Value>{};
    else
      return Value{};
  }
  using Values = std::vector<decltype(entry())>;
};

// Appends a member of each row; one function for all members of a type, not one for each column.
template <class Entry>
CGEMIT_NOINLINE void append_members(const std::byte* from, std::size_t row_size, std::size_t n,
                                    std::vector<Entry>& values) {
  values.resize(values.size() + n);
  Entry* const to = values.data() + values.size() - n;
  for (std::size_t i = 0; i < n; ++i) std::memcpy(to + i, from + i * row_size, sizeof(Entry));
}

template <class Row>
class Columns {
 public:
  // Place of the next row, which is there once `keep` is called. Filling it saves a copy.
  Row& next() { return waiting_[n_waiting_]; }
  void keep() {
    if (++n_waiting_ == block) write();
  }
  void push_back(const Row& row) {
    next() = row;
    keep();
  }
  void append(std::span<const Row> rows) {
    write();
    store(rows);
  }
  std::size_t size() const { return n_written_ + n_waiting_; }
  void reserve(std::size_t n) {
    each([n](const auto&, auto& values) { values.reserve(n); });
  }
  // Calls a function with the name and the values of every column.
  template <class F>
  void each_column(F&& f) {
    write();
    each([&f](const auto& column, auto& values) { f(column.name, values); });
  }

 private:
  static constexpr std::size_t block = 64;  // rows that wait together: one loop for each column

  void write() { store(std::span<const Row>(waiting_).first(std::exchange(n_waiting_, 0))); }
  void store(std::span<const Row> rows) {
    if (rows.empty()) return;
    each([rows](const auto& column, auto& values) {
      append_members(reinterpret_cast<const std::byte*>(&(rows.front().*column.value)), sizeof(Row),
                     rows.size(), values);
    });
    n_written_ += rows.size();
  }

  template <class F>
  void each(F&& f) {
    std::apply(
        [&](const auto&... column) {
          std::apply([&](auto&... values) { (f(column, values), ...); }, values_);
        },
        Row::columns());
  }
  template <class... C>
  static std::tuple<typename C::Values...> empty(const std::tuple<C...>&) {
    return {};
  }

  decltype(empty(Row::columns())) values_;
  std::vector<Row> waiting_ = std::vector<Row>(block);
  std::size_t n_written_ = 0, n_waiting_ = 0;
};

}  // namespace cgemit

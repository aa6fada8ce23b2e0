// Collects all problems of an input as text.
#pragma once

#include <array>
#include <charconv>
#include <cstddef>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace cgemit {

// The shortest text that gives the same number when read back.
inline std::string to_text(double value) {
  std::array<char, 32> text{};
  const auto end = std::to_chars(text.data(), text.data() + text.size(), value).ptr;
  return {text.data(), end};
}

class Problems {
 public:
  static constexpr std::size_t most = 50;  // that are listed

  // Only the first few dozen problems are listed; the others are counted.
  void add(std::string text) {
    if (lines_.size() < most) lines_.push_back(std::move(text));
    ++count_;
  }
  // Adds those of a part of the input.
  void add(const Problems& part, const std::string& where) {
    for (const std::string& line : part.lines_) add(where + " " + line);
    skip(part.count_ - part.lines_.size());
  }
  // Counts problems of which no text was made.
  void skip(std::size_t count) { count_ += count; }
  bool empty() const { return count_ == 0; }

  // Throws std::invalid_argument if there are any.
  void raise(const std::string& where) const {
    if (empty()) return;
    std::string text = where + ":";
    for (const std::string& line : lines_) text += "\n  " + line;
    if (count_ > lines_.size()) text += "\n  and " + std::to_string(count_ - lines_.size()) + " more";
    throw std::invalid_argument(text);
  }

 private:
  std::vector<std::string> lines_;
  std::size_t count_ = 0;
};

}  // namespace cgemit

// Seconds of the stages of a pass.
#pragma once
#include <chrono>

namespace panolog {

class Stopwatch {
 public:
  void lap(double& seconds) {
    const Clock::time_point now = Clock::now();
    seconds = std::chrono::duration<double>(now - last_).count(), last_ = now;
  }

 private:
  using Clock = std::chrono::steady_clock;
  Clock::time_point last_ = Clock::now();
};

}  // namespace panolog

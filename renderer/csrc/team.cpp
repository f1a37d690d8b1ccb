#include "team.h"

#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <utility>

namespace panolog {
namespace {

using Clock = std::chrono::steady_clock;

constexpr uint64_t kOpen = 1, kHelper = 2, kLoop = uint64_t(1) << 32;  // in Team::state_

// How long a thread that waits stays awake: most gaps between two loops of an iteration of training are shorter, and
// one that sleeps starts some 50 µs late.
constexpr std::chrono::microseconds kHelperLooks{2000}, kCallerLooks{50};
constexpr std::chrono::microseconds kPaused{200};  // between two looks at the clock: another thread had the core

void relax() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

// Waits until ready(): awake for `looks`, or until the system gives the core to another, then asleep until word is
// notified.
template <class Ready>
void wait(std::atomic<uint32_t>& word, Clock::duration looks, Ready ready) {
  const Clock::time_point start = Clock::now();
  for (Clock::time_point last = start, now = start; now - start < looks && now - last < kPaused;) {
    for (int i = 0; i < 64; ++i) {
      if (ready()) return;
      relax();
    }
    last = now, now = Clock::now();
  }
  while (true) {
    const uint32_t value = word.load();
    if (ready()) return;
    word.wait(value);
  }
}

}  // namespace

Team& Team::of_this_thread() {
  static thread_local Team team;
  return team;
}

Team::~Team() {
  if (process_ != getpid()) {  // a fork: the helpers are the parent's
    for (std::thread& helper : helpers_) helper.detach();
    return;
  }
  ends_ = true;
  ++calls_;
  calls_.notify_all();
  for (std::thread& helper : helpers_) helper.join();
}

void Team::run(int64_t parts, int threads, void (*work)(void*, int64_t), void* context) {
  if (threads <= 1 || parts <= 1) {
    for (int64_t part = 0; part < parts; ++part) work(context, part);
    return;
  }
  const uint32_t helpers = uint32_t(std::min<int64_t>(threads, parts) - 1);
  if (process_ != getpid()) {
    for (std::thread& helper : helpers_) helper.detach();
    helpers_.clear();
    process_ = getpid();
  }
  while (helpers_.size() < helpers) helpers_.emplace_back(&Team::help, this, uint32_t(helpers_.size()));
  loop_ = {work, context, parts, helpers};
  next_ = 0;
  const uint64_t loop = state_.load() / kLoop + 1;
  state_ = loop * kLoop | kOpen;
  ++calls_;
  calls_.notify_all();
  take_parts();
  state_ &= ~kOpen;
  wait(leaves_, kCallerLooks, [&] { return state_.load() % kLoop == 0; });
  if (failed_) {
    failed_ = false;
    std::rethrow_exception(std::exchange(failure_, nullptr));
  }
}

void Team::take_parts() {
  for (int64_t part; (part = next_++) < loop_.parts;) try {
      loop_.work(loop_.context, part);
    } catch (...) {
      if (!failed_.exchange(true)) failure_ = std::current_exception();
      next_ = loop_.parts;
    }
}

void Team::help(uint32_t index) {
  for (uint64_t last = 0; true;) {  // number of the latest loop that this one was in
    uint64_t state = 0;
    wait(calls_, kHelperLooks, [&] {
      state = state_.load();
      return ends_ || (state & kOpen && state / kLoop != last);
    });
    if (ends_) return;
    last = state / kLoop;
    while (state & kOpen && state / kLoop == last)
      if (state_.compare_exchange_weak(state, state + kHelper)) {
        if (index < loop_.helpers) take_parts();
        state_ -= kHelper;
        ++leaves_;
        leaves_.notify_one();
        break;
      }
  }
}

}  // namespace panolog

// Threads that share work part by part, such that one that the system does not run holds up nothing but the part
// that it has begun. An OpenMP team ends each loop with a barrier, which waits for every thread: next to a busy
// process, that is a wait for a time slice of the system at every loop.
#pragma once
#include <atomic>
#include <cstdint>
#include <exception>
#include <thread>
#include <vector>

namespace panolog {

// The calling thread and its helpers. Helpers join when the system runs them, look for more work for a short time
// after each loop, and then sleep.
class Team {
 public:
  Team() = default;
  ~Team();
  Team(const Team&) = delete;
  // Calls work(context, part) once for each part in 0 .. parts, on at most `threads` threads. Rethrows the first
  // exception of a part, once no part runs any more; parts not begun by then are left out.
  void run(int64_t parts, int threads, void (*work)(void*, int64_t), void* context);
  static Team& of_this_thread();

 private:
  struct Loop {
    void (*work)(void*, int64_t);
    void* context;
    int64_t parts;
    uint32_t helpers;  // that may join
  };
  void help(uint32_t index);
  void take_parts();

  Loop loop_{};
  std::atomic<int64_t> next_{0};                // the next part that no thread has begun
  std::atomic<uint64_t> state_{0};              // number of the loop · 2³², helpers in it · 2, whether one may join
  std::atomic<uint32_t> calls_{0}, leaves_{0};  // for the sleepers: new loops, and helpers that have left one
  std::atomic<bool> ends_{false}, failed_{false};
  std::exception_ptr failure_;
  std::vector<std::thread> helpers_;
  int process_ = 0;  // the one that the helpers are in
};

// Calls work(part) in parallel, once for each part in 0 .. parts.
template <class Work>
void share(int64_t parts, int threads, Work work) {
  Team::of_this_thread().run(
      parts, threads, [](void* context, int64_t part) { (*static_cast<Work*>(context))(part); }, &work);
}

// Calls visit(begin, end) in parallel for ranges of `span` that cover 0 .. count.
template <class Visit>
void each_span(int64_t count, int threads, int64_t span, Visit visit) {
  share((count + span - 1) / span, threads, [&](int64_t part) {
    const int64_t begin = part * span;
    visit(begin, begin + span < count ? begin + span : count);
  });
}

}  // namespace panolog

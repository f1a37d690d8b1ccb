// The few features of CUDA that csrc/cuda uses, on the host, strictly: a block's threads are fibers that run one
// after the other from barrier to barrier. What would hang or be undefined on a card is reported.
#pragma once
#include <setjmp.h>
#include <ucontext.h>

#include <cmath>
#include <cstdint>
#include <cstring>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(threads)
// Shared memory lies in a section of its own: every block finds it full of NaN.
#define __shared__ static __attribute__((section("cuda_shared")))
extern "C" __attribute__((visibility("hidden"))) char __start_cuda_shared[], __stop_cuda_shared[];
#pragma weak __start_cuda_shared
#pragma weak __stop_cuda_shared

struct Dim3 {
  unsigned x, y, z;
};
inline Dim3 gridDim, blockDim, blockIdx, threadIdx;

using std::max;
using std::min;

namespace emulation {

constexpr int kWarp = 32;
constexpr size_t kStack = 64 << 10;  // bytes of a fiber

struct Fiber {
  ucontext_t context;
  jmp_buf state;
  std::vector<char> stack = std::vector<char>(kStack);
  bool started, done;
};

// Where threads meet: all of a block, or all of a warp.
struct Gate {
  int size, arrived = 0;
  unsigned generation = 0;
  const char* operation = nullptr;
  int64_t tally[2] = {};           // of predicates, by the parity of the generation
  uint64_t values[2][kWarp] = {};  // of the lanes, likewise
};

struct Block {
  std::vector<Fiber> fibers;
  std::vector<Gate> warps;
  Gate all;
  int current = 0;
  int64_t moves = 0;  // arrivals and ends: when there are none, the block hangs
  jmp_buf scheduler;
  std::string error;
  void (*run)(void*);
  void* arguments;
};
inline Block block;

// Gives up the processor until the scheduler comes round again. Not swapcontext, which makes a system call each time.
inline void yield() {
  if (!_setjmp(block.fibers[block.current].state)) _longjmp(block.scheduler, 1);
  threadIdx = {unsigned(block.current), 0, 0};
}

[[noreturn]] inline void fail(const std::string& reason) {
  block.error = reason + " (thread " + std::to_string(block.current) + " of block " + std::to_string(blockIdx.x) +
                ", " + std::to_string(blockIdx.y) + ")";
  for (;;) _longjmp(block.scheduler, 1);
}

// Waits for all threads of a gate. Returns the parity under which they left what they brought.
template <class Bring>
int meet(Gate& gate, const char* operation, Bring bring) {
  const unsigned generation = gate.generation;
  const int parity = generation & 1;
  if (gate.arrived == 0) gate.operation = operation, gate.tally[parity] = 0;
  if (gate.operation != operation) fail(std::string(gate.operation) + " meets " + operation);
  bring(parity);
  ++block.moves;
  if (++gate.arrived == gate.size) {
    gate.arrived = 0, ++gate.generation;
  } else {
    while (gate.generation == generation) yield();
  }
  return parity;
}

inline Gate& warp() { return block.warps[block.current / kWarp]; }
inline int lane() { return block.current % kWarp; }

inline void check(uint32_t mask) {
  if (mask != 0xffffffffu) fail("a warp operation that is not for all lanes");
}

template <class T>
T shuffle(T value, int from, const char* operation) {
  static_assert(sizeof(T) <= sizeof(uint64_t), "one register or two");
  Gate& gate = warp();
  const int parity = meet(gate, operation, [&](int p) { std::memcpy(&gate.values[p][lane()], &value, sizeof(T)); });
  std::memcpy(&value, &gate.values[parity][from < kWarp ? from : lane()], sizeof(T));
  return value;
}

inline void enter() {
  block.run(block.arguments);
  block.fibers[block.current].done = true;
  ++block.moves;
  for (;;) _longjmp(block.scheduler, 1);
}

inline void start(Fiber& fiber) {
  fiber.started = true;
  getcontext(&fiber.context);
  fiber.context.uc_stack.ss_sp = fiber.stack.data();
  fiber.context.uc_stack.ss_size = fiber.stack.size();
  fiber.context.uc_link = nullptr;
  makecontext(&fiber.context, enter, 0);
  setcontext(&fiber.context);
}

// Runs a thread until it waits or ends.
inline void resume(int thread) {
  block.current = thread;
  threadIdx = {unsigned(thread), 0, 0};
  Fiber& fiber = block.fibers[thread];
  if (_setjmp(block.scheduler)) return;
  if (fiber.started) _longjmp(fiber.state, 1);
  start(fiber);
}

// All threads of a block, in rounds; the last thread first if `backwards`: a missing barrier shows in one order.
inline void run_block(int threads, bool backwards) {
  for (char* byte = __start_cuda_shared; byte != __stop_cuda_shared; ++byte) *byte = char(0xff);
  block.all = Gate{threads};
  block.warps.assign((threads + kWarp - 1) / kWarp, Gate{kWarp});
  for (Fiber& fiber : block.fibers) fiber.started = fiber.done = false;
  for (int64_t before = -1; before != block.moves && block.error.empty();) {
    before = block.moves;
    for (int i = 0; i < threads && block.error.empty(); ++i) {
      const int thread = backwards ? threads - 1 - i : i;
      if (!block.fibers[thread].done) resume(thread);
    }
  }
  for (int thread = 0; thread < threads && block.error.empty(); ++thread)
    if (!block.fibers[thread].done) block.error = "threads wait for others that never come";
}

// "p" pointer, "i" int64_t, "f" float, "b" and its size a struct: what the caller must have given.
template <class T>
std::string kind() {
  if (std::is_pointer<T>::value) return "p";
  if (std::is_same<T, int64_t>::value) return "i";
  if (std::is_same<T, float>::value) return "f";
  if (std::is_class<T>::value) return "b" + std::to_string(sizeof(T));
  return "?";
}

template <class... Args, size_t... Index>
const char* launch(void (*kernel)(Args...), const unsigned* grid, unsigned threads, bool backwards, const char* kinds,
                   void** values, std::index_sequence<Index...>) {
  std::string expected;
  for (const std::string& each : {kind<Args>()...}) expected += each;
  block.error.clear();
  if (expected != kinds) block.error = "arguments are " + std::string(kinds) + ", the kernel takes " + expected;
  if (threads % kWarp) block.error = "a block must be whole warps";
  auto call = [&] { kernel(*static_cast<std::remove_const_t<Args>*>(values[Index])...); };
  block.run = [](void* it) { (*static_cast<decltype(call)*>(it))(); };
  block.arguments = &call;
  block.fibers.resize(threads);
  gridDim = {grid[0], grid[1], 1}, blockDim = {threads, 1, 1};
  for (unsigned y = 0; y < grid[1]; ++y)
    for (unsigned x = 0; x < grid[0] && block.error.empty(); ++x) {
      blockIdx = {x, y, 0};
      run_block(int(threads), backwards);
    }
  return block.error.empty() ? nullptr : block.error.c_str();
}

template <class... Args>
const char* launch(void (*kernel)(Args...), const unsigned* grid, unsigned threads, bool backwards, const char* kinds,
                   void** values) {
  return launch(kernel, grid, threads, backwards, kinds, values, std::index_sequence_for<Args...>{});
}

}  // namespace emulation

inline void __syncthreads() {
  emulation::meet(emulation::block.all, "__syncthreads", [](int) {});
}

inline int __syncthreads_or(int predicate) {
  emulation::Gate& all = emulation::block.all;
  return all.tally[emulation::meet(all, "__syncthreads_or", [&](int p) { all.tally[p] += predicate != 0; })] != 0;
}

inline uint32_t __ballot_sync(uint32_t mask, int predicate) {
  emulation::check(mask);
  emulation::Gate& warp = emulation::warp();
  const int64_t bit = int64_t(predicate != 0) << emulation::lane();
  return uint32_t(warp.tally[emulation::meet(warp, "__ballot_sync", [&](int p) { warp.tally[p] += bit; })]);
}

inline int __any_sync(uint32_t mask, int predicate) {
  emulation::check(mask);
  emulation::Gate& warp = emulation::warp();
  return warp.tally[emulation::meet(warp, "__any_sync", [&](int p) { warp.tally[p] += predicate != 0; })] != 0;
}

template <class T>
T __shfl_xor_sync(uint32_t mask, T value, int lanes) {
  emulation::check(mask);
  return emulation::shuffle(value, emulation::lane() ^ lanes, "__shfl_xor_sync");
}

template <class T>
T __shfl_down_sync(uint32_t mask, T value, int lanes) {
  emulation::check(mask);
  return emulation::shuffle(value, emulation::lane() + lanes, "__shfl_down_sync");
}

inline int __ffs(int bits) { return __builtin_ffs(bits); }

inline void atomicAdd(float* to, float value) { *to += value; }
inline void atomicOr(int32_t* to, int32_t bits) { *to |= bits; }

// What the tests call: returns null or what went wrong.
#define CUDA_HOST_EXPORT(name)                                                                                \
  extern "C" const char* run_##name(const unsigned* grid, unsigned threads, int backwards, const char* kinds, \
                                    void** values) {                                                          \
    return emulation::launch(&name, grid, threads, backwards != 0, kinds, values);                            \
  }

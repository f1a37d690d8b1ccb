// The threads of a block as fibers, which run one at a time, in random order within what barriers allow. What would
// hang or be undefined on a card ends the launch with a reason.
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <ucontext.h>
#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

#include <algorithm>
#include <numeric>
#include <random>
#include <string>
#include <vector>

#include "emulation.h"

Dim3 gridDim, blockDim, blockIdx, threadIdx;

namespace emulation {

Place place;
Range stack;

namespace {

struct Fiber {
  ucontext_t context;
  jmp_buf state;
  std::vector<char> stack = std::vector<char>(kStack);
  bool started;
};

// Where threads meet: all of a block, or all of a warp.
struct Gate {
  int size;
  unsigned generation = 0;
  uint32_t phase = 0;  // how many barriers: the operations that order accesses
  const char* operation = nullptr;
  std::vector<int> waiting = {};
  int64_t tally[2] = {};           // of predicates, by the parity of the generation
  uint64_t values[2][kWarp] = {};  // of the lanes, likewise
};

struct Block {
  std::vector<Fiber> fibers;
  std::vector<Gate> warps;
  Gate all;
  std::vector<int> ready;  // threads that can run
  int current, running;    // threads that have not ended
  jmp_buf scheduler;
  std::string error;
  const Launch* launch;
};
Block block;

Gate& warp() { return block.warps[block.current / kWarp]; }
int lane() { return block.current % kWarp; }

void leave() { stack = {}, _longjmp(block.scheduler, 1); }

// Not swapcontext, which makes a system call each time.
void yield() {
  if (!_setjmp(block.fibers[block.current].state)) leave();
}

// Waits for all threads of a gate. Returns the parity under which they left what they brought.
template <class Bring>
int meet(Gate& gate, const char* operation, bool barrier, Bring bring) {
  const int parity = gate.generation & 1;
  if (gate.waiting.empty()) gate.operation = operation, gate.tally[parity] = 0;
  if (strcmp(gate.operation, operation)) fail("%s meets %s", gate.operation, operation);
  bring(parity);
  gate.waiting.push_back(block.current);
  if (int(gate.waiting.size()) == gate.size) {
    ++gate.generation, gate.phase += barrier;
    block.ready.insert(block.ready.end(), gate.waiting.begin(), gate.waiting.end());
    gate.waiting.clear();
  }
  yield();
  return parity;
}

void check(const char* operation, uint32_t mask) {
  if (mask != 0xffffffffu) fail("%s is not for all lanes, but for %#x", operation, mask);
}

void enter() {
  block.launch->enter(block.launch->values);
  --block.running;
  for (;;) leave();
}

void start(Fiber& fiber) {
  fiber.started = true;
  getcontext(&fiber.context);
  fiber.context.uc_stack.ss_sp = fiber.stack.data();
  fiber.context.uc_stack.ss_size = fiber.stack.size();
  fiber.context.uc_link = nullptr;
  makecontext(&fiber.context, enter, 0);
  setcontext(&fiber.context);
}

// Runs a thread until it waits or ends.
void resume(int thread) {
  block.current = thread;
  threadIdx = {unsigned(thread), 0, 0};
  const uint32_t number = blockIdx.y * gridDim.x + blockIdx.x + 1;
  place = {number, block.all.phase, warp().phase, int16_t(thread / kWarp + 1), int16_t(thread + 1)};
  Fiber& fiber = block.fibers[thread];
  stack = {fiber.stack.data(), fiber.stack.data() + kStack};
  if (_setjmp(block.scheduler)) return;
  if (fiber.started) _longjmp(fiber.state, 1);
  start(fiber);
}

void run_block(std::mt19937_64& random) {
  const int threads = int(blockDim.x);
  begin_block();
  block.all = Gate{threads};
  block.warps.assign(threads / kWarp, Gate{kWarp});
  for (Fiber& fiber : block.fibers) fiber.started = false;
  block.ready.resize(threads), block.running = threads;
  std::iota(block.ready.begin(), block.ready.end(), 0);
  while (!block.ready.empty() && block.error.empty()) {
    std::swap(block.ready[random() % block.ready.size()], block.ready.back());
    const int thread = block.ready.back();
    block.ready.pop_back();
    resume(thread);
  }
  if (block.running && block.error.empty())
    block.error = std::to_string(block.running) + " threads wait for others that never come (block " +
                  std::to_string(blockIdx.x) + ", " + std::to_string(blockIdx.y) + ")";
}

// What is wrong with how a kernel is called, or nothing.
std::string mismatch(const Launch& launch) {
  std::string taken;
  for (const ArgumentKind* it = launch.taken_begin; it != launch.taken_end; ++it)
    taken += it->letter + (it->size ? std::to_string(it->size) : std::string());
  if (taken != launch.kinds) return "arguments are " + std::string(launch.kinds) + ", the kernel takes " + taken;
  return launch.threads % kWarp ? "a block must be whole warps" : "";
}

// Flushes denormals to zero for as long as it lives, on x86.
struct Flush {
#if defined(__x86_64__)
  const unsigned before = _mm_getcsr();
  explicit Flush(bool wanted) { _mm_setcsr(wanted ? before | 0x8040u : before); }  // FTZ and DAZ
  ~Flush() { _mm_setcsr(before); }
#else
  explicit Flush(bool) {}
#endif
};

}  // namespace

void fail(const char* format, ...) {
  char reason[1024];
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(reason, sizeof(reason), format, arguments);
  va_end(arguments);
  block.error = std::string(reason) + " (thread " + std::to_string(block.current) + " of block " +
                std::to_string(blockIdx.x) + ", " + std::to_string(blockIdx.y) + ")";
  for (;;) leave();
}

const char* run(const Launch& launch) {
  const Flush flush(launch.flush);
  std::mt19937_64 random(launch.seed);
  block.launch = &launch;
  block.error = mismatch(launch);
  block.fibers.resize(launch.threads);
  gridDim = {launch.grid[0], launch.grid[1], 1}, blockDim = {launch.threads, 1, 1};
  begin_launch(launch);
  std::vector<unsigned> blocks(size_t(gridDim.x) * gridDim.y);
  std::iota(blocks.begin(), blocks.end(), 0u);
  std::shuffle(blocks.begin(), blocks.end(), random);
  for (size_t i = 0; i < blocks.size() && block.error.empty(); ++i) {
    blockIdx = {blocks[i] % gridDim.x, blocks[i] / gridDim.x, 0};
    run_block(random);
  }
  return block.error.empty() ? nullptr : block.error.c_str();
}

uint64_t exchange(const char* operation, uint32_t mask, uint64_t value, int from) {
  check(operation, mask);
  Gate& gate = warp();
  const int parity = meet(gate, operation, false, [&](int p) { gate.values[p][lane()] = value; });
  return gate.values[parity][from >= 0 && from < kWarp ? from : lane()];
}

}  // namespace emulation

using emulation::block;
using emulation::Gate;
using emulation::meet;
using emulation::warp;

void __syncthreads() {
  meet(block.all, "__syncthreads", true, [](int) {});
}

int __syncthreads_or(int predicate) {
  Gate& all = block.all;
  return all.tally[meet(all, "__syncthreads_or", true, [&](int p) { all.tally[p] += predicate != 0; })] != 0;
}

// The only operation of a warp that orders accesses here: of votes and shuffles CUDA promises no memory ordering.
void __syncwarp(uint32_t mask) {
  emulation::check("__syncwarp", mask);
  meet(warp(), "__syncwarp", true, [](int) {});
}

uint32_t __ballot_sync(uint32_t mask, int predicate) {
  emulation::check("__ballot_sync", mask);
  Gate& gate = warp();
  const int64_t bit = int64_t(predicate != 0) << emulation::lane();
  return uint32_t(gate.tally[meet(gate, "__ballot_sync", false, [&](int p) { gate.tally[p] += bit; })]);
}

int __any_sync(uint32_t mask, int predicate) { return __ballot_sync(mask, predicate) != 0; }

// What the emulated kernels (host.h), their threads (threads.cpp) and their memory (memory.cpp) share.
#pragma once
#include <stddef.h>
#include <stdint.h>

struct Dim3 {
  unsigned x, y, z;
};
extern Dim3 gridDim, blockDim, blockIdx, threadIdx;

namespace emulation {

constexpr int kWarp = 32;
constexpr size_t kStack = 64 << 10;  // bytes of a fiber

struct Range {
  const char *begin, *end;
  bool has(const void* address) const { return address >= begin && address < end; }
};

struct Tensor {  // an argument of a launch, in global memory
  const char* name;
  char* data;
  int64_t bytes, unit;  // bytes in all and of an element
  uint8_t* written;     // for each byte whether it has a value; null where all have
};

struct ArgumentKind {
  char letter;  // p pointer, i int64_t, f float, b a struct by value
  size_t size;  // of the struct
};

struct SharedVariable {  // made by build.py from the assembly
  const char* name;
  char* data;
  int64_t bytes;
};

struct Library {  // of one .cu file
  Range image;    // all that is loaded of it
  char *shared_begin, *shared_end;
  const SharedVariable *variables_begin, *variables_end;
};

struct Launch {
  void (*enter)(void** values);  // calls the kernel
  void** values;                 // of its arguments
  const char* kinds;             // of the values: letters, after each b its size
  const unsigned* grid;
  unsigned threads;
  uint64_t seed;  // of the order of blocks and threads
  bool flush;     // denormals to zero
  const Tensor *tensors_begin, *tensors_end;
  const ArgumentKind *taken_begin, *taken_end;  // what the kernel takes
  Library library;
};

// Runs all blocks. Null, or what went wrong; lines are "+0x" and their offset in the library.
const char* run(const Launch& launch);

// Ends the launch with a reason. Called on a fiber.
[[noreturn]] void fail(const char* format, ...) __attribute__((format(printf, 1, 2)));

// Where the running thread is, for the order of accesses. Numbers from 1: 0 is none.
struct Place {
  uint32_t block, phase, warp_phase;  // phases: barriers of the block, of the warp so far
  int16_t warp, thread;
};
extern Place place;
extern Range stack;  // of the running fiber; empty between them

enum Kind { kRead, kWrite, kAtomic };
void access(Kind kind, const void* address, size_t size, const void* code);
void begin_launch(const Launch& launch);
void begin_block();

// What lanes bring to an operation of their warp.
uint64_t exchange(const char* operation, uint32_t mask, uint64_t value, int from);

}  // namespace emulation

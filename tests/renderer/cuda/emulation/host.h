// The few features of CUDA that csrc/cuda uses, for kernels that are compiled for the host with -fsanitize=thread.
#pragma once
#include <math.h>
#include <string.h>

#include <type_traits>
#include <utility>

#include "emulation.h"

#define __global__ __attribute__((noinline))
#define __device__
#define __forceinline__ inline __attribute__((always_inline))
#define __launch_bounds__(threads)
#define __shared__ static __attribute__((section("cuda_shared")))
#define CUDA_HOST_UNCHECKED __attribute__((noinline, no_sanitize("thread", "bounds", "alignment")))

struct alignas(16) float4 {
  float x, y, z, w;
};

template <class T>
T min(T a, T b) {
  return b < a ? b : a;
}
template <class T>
T max(T a, T b) {
  return a < b ? b : a;
}

// Threads of a block; threads.cpp
void __syncthreads();
int __syncthreads_or(int predicate);
void __syncwarp(uint32_t mask = 0xffffffffu);
uint32_t __ballot_sync(uint32_t mask, int predicate);
int __any_sync(uint32_t mask, int predicate);

template <class T>
T cuda_host_shuffle(const char* operation, uint32_t mask, T value, int from) {
  static_assert(sizeof(T) <= sizeof(uint64_t), "one register or two");
  uint64_t bits = 0;
  memcpy(&bits, &value, sizeof(T));
  bits = emulation::exchange(operation, mask, bits, from);
  memcpy(&value, &bits, sizeof(T));
  return value;
}

template <class T>
T __shfl_xor_sync(uint32_t mask, T value, int lanes) {
  return cuda_host_shuffle("__shfl_xor_sync", mask, value, (int(threadIdx.x) % emulation::kWarp) ^ lanes);
}

template <class T>
T __shfl_down_sync(uint32_t mask, T value, int lanes) {
  return cuda_host_shuffle("__shfl_down_sync", mask, value, int(threadIdx.x) % emulation::kWarp + lanes);
}

inline int __ffs(int bits) { return __builtin_ffs(bits); }
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }

#define CUDA_HOST_ATOMIC(name, result)                                                 \
  template <class T>                                                                   \
  CUDA_HOST_UNCHECKED T name(T* to, std::common_type_t<T> value) {                     \
    emulation::access(emulation::kAtomic, to, sizeof(T), __builtin_return_address(0)); \
    const T before = *to;                                                              \
    *to = result;                                                                      \
    return before;                                                                     \
  }
CUDA_HOST_ATOMIC(atomicAdd, before + value)
CUDA_HOST_ATOMIC(atomicOr, T(before | value))

namespace emulation {

template <class T>
constexpr ArgumentKind kind() {
  if (std::is_pointer<T>::value) return {'p', 0};
  if (std::is_same<T, int64_t>::value) return {'i', 0};
  if (std::is_same<T, float>::value) return {'f', 0};
  return {std::is_class<T>::value ? 'b' : '?', sizeof(T)};
}

template <auto kernel>
struct Entry;

template <class... Args, void (*kernel)(Args...)>
struct Entry<kernel> {
  template <size_t... Index>
  CUDA_HOST_UNCHECKED static void call(void** values, std::index_sequence<Index...>) {
    kernel(*static_cast<std::remove_const_t<Args>*>(values[Index])...);
  }
  CUDA_HOST_UNCHECKED static void enter(void** values) { call(values, std::index_sequence_for<Args...>{}); }
  static constexpr ArgumentKind kinds[] = {kind<Args>()...};
};

}  // namespace emulation

// Of the linker: the library, its shared memory and the table of its shared variables.
extern "C" __attribute__((visibility("hidden"))) char __ehdr_start[], _end[];
extern "C" __attribute__((visibility("hidden"))) char __start_cuda_shared[], __stop_cuda_shared[];
extern "C" __attribute__((visibility("hidden"))) const emulation::SharedVariable __start_cuda_variables[],
    __stop_cuda_variables[];
#pragma weak __start_cuda_shared
#pragma weak __stop_cuda_shared
#pragma weak __start_cuda_variables
#pragma weak __stop_cuda_variables

// What Python calls: returns null or what went wrong.
#define CUDA_HOST_EXPORT(kernel)                                                                                       \
  extern "C" const char* run_##kernel(emulation::Launch launch) {                                                      \
    using Entry = emulation::Entry<&kernel>;                                                                           \
    launch.enter = Entry::enter;                                                                                       \
    launch.taken_begin = Entry::kinds;                                                                                 \
    launch.taken_end = Entry::kinds + sizeof(Entry::kinds) / sizeof(emulation::ArgumentKind);                          \
    launch.library = {                                                                                                 \
        {__ehdr_start, _end}, __start_cuda_shared, __stop_cuda_shared, __start_cuda_variables, __stop_cuda_variables}; \
    return emulation::run(launch);                                                                                     \
  }

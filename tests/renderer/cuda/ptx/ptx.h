// PTX's instructions as functions, for what translation.py makes of a program: by NVIDIA's "PTX ISA", chapter
// "Instruction Set". Registers are untyped bits, as there; `as` reads one as a type and `set` writes one.
#pragma once
#include <fenv.h>
#include <float.h>

#include <limits>

#include "host.h"

// Where approximate instructions lie within their documented error: 0 the nearest value, +1 as high and -1 as low as
// allowed, 2 one of these by the bits of the result.
#ifndef PTX_ERROR
#define PTX_ERROR 0
#endif

namespace ptx {

template <size_t N, size_t Align>
struct Bytes {  // a struct by value
  alignas(Align) char bytes[N];
};

template <class T, class R>
T as(R bits) {
  if constexpr (std::is_same<T, bool>::value || std::is_same<R, bool>::value) {
    static_assert(std::is_same<T, R>::value, "a predicate is no number");
    return bits;
  } else if constexpr (sizeof(T) == sizeof(R)) {
    T value;
    memcpy(&value, &bits, sizeof(T));
    return value;
  } else {
    static_assert(std::is_integral<T>::value && sizeof(T) < sizeof(R), "only integers are read from wider registers");
    return T(bits);
  }
}

template <class R, class T>
void set(R& bits, T value) {
  if constexpr (sizeof(T) == sizeof(R)) {
    static_assert(std::is_same<T, bool>::value == std::is_same<R, bool>::value, "a predicate is no number");
    memcpy(&bits, &value, sizeof(T));
  } else {
    static_assert(std::is_integral<T>::value && sizeof(T) < sizeof(R), "only integers go to wider registers");
    bits = R(value);  // with its sign
  }
}

// .ftz: subnormals become zero with their sign.
inline float flush(float x) { return fabsf(x) < FLT_MIN ? copysignf(0.0f, x) : x; }
template <class T>
T flush(T x) {
  return x;
}

// What C++ promotes to int wraps as well.
template <class T>
T add(T a, T b) {
  return T(a + b);
}
template <class T>
T sub(T a, T b) {
  return T(a - b);
}
template <class T>
T mul(T a, T b) {
  return T(a * b);
}
inline uint16_t mul(uint16_t a, uint16_t b) { return uint16_t(uint32_t(a) * b); }

template <class W, class T>
W mul_wide(T a, T b) {
  return W(W(a) * W(b));
}
template <class W, class T>
T mul_high(T a, T b) {
  return T(W(W(a) * W(b)) >> (8 * sizeof(T)));
}

inline float fma(float a, float b, float c) { return fmaf(a, b, c); }
inline double fma(double a, double b, double c) { return ::fma(a, b, c); }

__attribute__((noinline)) inline float fma_down(float a, float b, float c) {
  volatile float x = a;
  fesetround(FE_DOWNWARD);
  volatile float result = fmaf(x, b, c);
  fesetround(FE_TONEAREST);
  return result;
}

template <class T>
T divide(T a, T b) {  // by zero: a value that ISA leaves open
  if constexpr (std::is_integral<T>::value) {
    if (b == 0) return T(0xfefefefefefefefe);
    if (std::is_signed<T>::value && b == T(-1)) return T(0 - std::make_unsigned_t<T>(a));
  }
  return a / b;
}

inline float sqrt(float a) { return sqrtf(a); }
inline double sqrt(double a) { return ::sqrt(a); }
template <class T>
T magnitude(T a) {
  if constexpr (std::is_integral<T>::value) return a < 0 ? T(0 - std::make_unsigned_t<T>(a)) : a;
  return T(copysign(a, T(1)));
}
template <class T>
T negative(T a) {
  if constexpr (std::is_integral<T>::value) return T(0 - std::make_unsigned_t<T>(a));
  return -a;
}
inline float copy_sign(float from, float to) { return copysignf(to, from); }

// Of a NaN and a number the number; -0 is less than +0.
template <class T>
T least(T a, T b) {
  if constexpr (!std::is_integral<T>::value) {
    if (a != a || b != b) return a != a ? (b != b ? T(as<float>(0x7fffffffu)) : b) : a;
    if (a == b) return signbit(a) ? a : b;
  }
  return a < b ? a : b;
}
template <class T>
T most(T a, T b) {
  if constexpr (!std::is_integral<T>::value) {
    if (a != a || b != b) return least(a, b);
    if (a == b) return signbit(a) ? b : a;
  }
  return a < b ? b : a;
}

// A shift by more than all bits gives what is left of the value: zeros, or its sign.
template <class T>
T shift_left(T a, uint32_t by) {
  return by < 8 * sizeof(T) ? T(a << by) : T(0);
}
template <class T>
T shift_right(T a, uint32_t by) {
  constexpr uint32_t bits = 8 * sizeof(T);
  return by < bits ? T(a >> by) : std::is_signed<T>::value ? T(a >> (bits - 1)) : T(0);
}

inline uint32_t reverse_bits(uint32_t a) {
  uint32_t result = 0;
  for (int i = 0; i < 32; ++i) result |= (a >> i & 1u) << (31 - i);
  return result;
}
inline uint32_t count_bits(uint32_t a) { return uint32_t(__builtin_popcount(a)); }
inline uint32_t leading_zeros(uint32_t a) { return a ? uint32_t(__builtin_clz(a)) : 32u; }
inline uint32_t find_shift(uint32_t a) { return a ? uint32_t(__builtin_clz(a)) : ~0u; }
inline uint32_t insert_bits(uint32_t field, uint32_t into, uint32_t at, uint32_t length) {
  at &= 0xff, length &= 0xff;
  const uint32_t ones = length < 32 ? (1u << length) - 1 : ~0u;
  const uint32_t mask = shift_left(ones, at);
  return (into & ~mask) | (shift_left(field, at) & mask);
}

// Conversions. Floats that no integer is near to become the nearest one there is, NaN becomes 0.
template <class T, class F>
T to_integer(F x) {
  using Limits = std::numeric_limits<T>;
  if (x != x) return 0;
  if (x < F(Limits::min())) return Limits::min();
  return x >= 2 * F(Limits::max() / 2 + 1) ? Limits::max() : T(x);
}
inline float saturate(float x) { return x > 0 ? (x < 1 ? x : 1.0f) : 0.0f; }  // also NaN to +0

// Approximations: the nearest float, or the furthest one within an error.
inline float within(double exact, double error) {
  const float nearest = float(exact);
  if (PTX_ERROR == 0 || exact == 0 || !std::isfinite(exact) || !std::isfinite(nearest)) return nearest;
  const uint32_t bits = as<uint32_t>(nearest) * 2654435761u;
  const bool up = PTX_ERROR == 2 ? bits >> 31 : PTX_ERROR > 0;
  const double limit = up ? exact + error : exact - error;
  const float result = float(limit);
  return up == (double(result) > limit) && double(result) != limit ? nextafterf(result, nearest) : result;
}
inline double ulps(double exact, int count) {
  return exact == 0 || !std::isfinite(exact) ? 0 : ldexp(count, ilogb(exact) - 23);
}
inline double relative(double exact, double error) { return fabs(exact) * error; }

inline float div_approx(float a, float b) {
  const double exact = double(a) / double(b);
  if (fabsf(b) > 0x1p126f && !std::isinf(b))
    return std::isinf(a) ? std::numeric_limits<float>::quiet_NaN() : float(copysign(0.0, exact));
  return within(exact, ulps(exact, 2));
}
inline float rcp_approx(float a) { return within(1 / double(a), ulps(1 / double(a), 1)); }
inline float sqrt_approx(float a) { return within(::sqrt(double(a)), relative(::sqrt(double(a)), 0x1p-23)); }
inline float rsqrt_approx(float a) {
  const double exact = 1 / ::sqrt(double(a));
  return within(exact, relative(exact, 0x1p-22 * 0.5359));  // 2^-22.9
}
inline float ex2_approx(float a) { return within(exp2(double(a)), relative(exp2(double(a)), 0x1p-22)); }
inline float lg2_approx(float a) {
  const double exact = log2(double(a));
  return within(exact, a > 0.5f && a < 2 ? 0x1p-22 : relative(exact, 0x1p-22));
}
inline double of_turn(float a) {  // error of sine and cosine: 2^-20.5, 2^-14.7
  if (fabsf(a) > 314.15927f) emulation::fail("no error is documented of a sine or cosine of %g", double(a));
  return fabsf(a) <= 6.2831855f ? 0x1p-20 * 0.70711 : 0x1p-14 * 0.61557;
}
inline float sin_approx(float a) { return within(::sin(double(a)), of_turn(a)); }
inline float cos_approx(float a) { return within(::cos(double(a)), of_turn(a)); }

// Memory. One access for each instruction, so that a vector is aligned as a whole; `used` are the bytes that the
// compiler says are used of it.
template <class T, int N>
struct Vector {
  T of[N];
};

template <class T, int N>
CUDA_HOST_UNCHECKED Vector<T, N> load(const char* at, uint32_t used) {
  const void* const code = __builtin_return_address(0);
  Vector<T, N> result;
  if (~used << (32 - sizeof(result)) == 0) {
    emulation::access(emulation::kRead, at, sizeof(result), code);
  } else {
    if (uintptr_t(at) % sizeof(result)) emulation::fail("misaligned: reads %d bytes", int(sizeof(result)));
    for (size_t i = 0; i < sizeof(result); i += sizeof(T))
      if (used >> i & 1) emulation::access(emulation::kRead, at + i, sizeof(T), code);
  }
  memcpy(&result, at, sizeof(result));
  return result;
}

template <class T, int N>
CUDA_HOST_UNCHECKED void store(char* at, Vector<T, N> values) {
  emulation::access(emulation::kWrite, at, sizeof(values), __builtin_return_address(0));
  memcpy(at, &values, sizeof(values));
}

struct Span {  // a variable in shared or local memory, or a parameter
  char* begin;
  uint64_t bytes;
};

// Shared variable k has the addresses from (k + 1) << 20 on: none continues in another.
constexpr int kWindow = 20;
inline char* shared_at(const Span* variables, uint64_t count, uint64_t address) {
  const uint64_t k = (address >> kWindow) - 1, offset = address & ((1u << kWindow) - 1);
  if (k >= count || offset >= variables[k].bytes + 16)  // what is just beyond is reported with its name
    emulation::fail("out of bounds: %#llx is no address in shared memory", (unsigned long long)(address));
  return variables[k].begin + offset;
}

// Of a thread's own memory and of parameters, which `access` does not check.
inline char* own_at(const Span* variables, uint64_t count, uint64_t address, uint64_t bytes) {
  for (uint64_t k = 0; k < count; ++k) {
    const uint64_t offset = address - uint64_t(variables[k].begin);
    if (offset > variables[k].bytes || bytes > variables[k].bytes - offset) continue;
    if (offset % bytes) emulation::fail("misaligned: %d bytes at byte %d", int(bytes), int(offset));
    return variables[k].begin + offset;
  }
  emulation::fail("out of bounds: %d bytes are in no local variable or parameter", int(bytes));
}

struct Add {
  template <class T>
  T operator()(T a, T b) const {
    return flush(T(flush(a) + flush(b)));  // in global memory f32 is flushed without .ftz
  }
};
struct Or {
  template <class T>
  T operator()(T a, T b) const {
    return T(a | b);
  }
};
template <class Operation, class T>
CUDA_HOST_UNCHECKED T atomic(char* at, T value) {
  emulation::access(emulation::kAtomic, at, sizeof(T), __builtin_return_address(0));
  T before;
  memcpy(&before, at, sizeof(T));
  const T after = Operation()(before, value);
  memcpy(at, &after, sizeof(T));
  return before;
}

// Of a thread in a loop: one that never ends would end no test.
inline void turn(uint32_t& turns) {
  if (++turns >> 16) emulation::fail("a loop does not end");
}

// Lanes and threads.
enum Shuffle { kUp, kDown, kButterfly, kIndex };
struct Shuffled {
  uint32_t value;
  bool inside;
};
inline Shuffled shuffle(Shuffle how, uint32_t value, uint32_t by, uint32_t limits, uint32_t mask) {
  constexpr const char* kNames[] = {"shfl.up", "shfl.down", "shfl.bfly", "shfl.idx"};
  const int lane = int(threadIdx.x % emulation::kWarp), clamp = int(limits & 31), segment = int(limits >> 8 & 31);
  const int first = lane & segment, last = first | (clamp & ~segment), steps = int(by & 31);
  const int from = how == kUp      ? lane - steps
                   : how == kDown  ? lane + steps
                   : how == kIndex ? first | (steps & ~segment)
                                   : lane ^ steps;
  const bool inside = how == kUp ? from >= last : from <= last;
  return {uint32_t(emulation::exchange(kNames[how], mask, value, inside ? from : lane)), inside};
}
inline uint32_t ballot(bool predicate, uint32_t mask) { return __ballot_sync(mask, predicate); }
inline bool any(bool predicate, uint32_t mask) { return __ballot_sync(mask, predicate) != 0; }
inline bool all(bool predicate, uint32_t mask) { return __ballot_sync(mask, predicate) == ~0u; }

}  // namespace ptx

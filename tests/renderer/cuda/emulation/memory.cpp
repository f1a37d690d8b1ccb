// The runtime that -fsanitize=thread calls, in place of libtsan: knows of each piece of shared and global memory
// whether it has a value, and who has accessed it since when. Two accesses are ordered if they are of one thread, or of
// one block with a barrier of the block (or of their warp) between; blocks of a grid never are. Two that are not, one
// of them a write, are a race, unless both are atomic. What -fsanitize=bounds,alignment finds is reported too.
#include <stdio.h>
#include <string.h>

#include <algorithm>
#include <vector>

#include "emulation.h"

extern "C" __attribute__((visibility("hidden"))) char __ehdr_start[], _end[];  // of this library

namespace emulation {
namespace {

constexpr int16_t kSeveral = -1;
constexpr uint32_t kSeveralBlocks = ~0u;
constexpr int64_t kSharedUnit = 4;  // bytes of shared memory that are checked as one

struct Seen {  // accesses of one kind that are not ordered among each other; with several by the first of them
  Place by;    // block 0: none
  uint32_t code;
};

struct Cell {
  Seen seen[3];  // by kind
};

struct Area {
  const char* name;
  char *begin, *end;
  int64_t unit;
  uint8_t* written;  // null in shared memory, and where all has a value
  bool shared;
  std::vector<Cell> cells;
};

std::vector<Area> areas;  // by address
Range image, shared;      // of the kernel's library, and of its shared memory with what lies between variables
const Range own_image = {__ehdr_start, _end};
constexpr const char* kVerb[] = {"reads", "writes", "atomically changes"};
constexpr const char* kParticiple[] = {"read", "written", "atomically changed"};

// Whether an access here and now is not ordered after those that were seen.
bool concurrent(const Place& seen) {
  if (seen.block != place.block) return seen.block != 0;
  if (seen.phase != place.phase) return false;
  if (seen.warp != place.warp) return true;
  return seen.warp_phase == place.warp_phase && seen.thread != place.thread;
}

void note(Seen& seen, uint32_t code) {
  Place& by = seen.by;
  if (by.block && by.block != place.block) {
    by.block = kSeveralBlocks;
  } else if (by.block && by.phase == place.phase && by.warp != place.warp) {
    by.warp = kSeveral;
  } else if (by.block && by.phase == place.phase && by.warp_phase == place.warp_phase && by.thread != place.thread) {
    by.thread = kSeveral;
  } else {
    seen = {place, code};
  }
}

uint32_t offset(const void* code) { return uint32_t(static_cast<const char*>(code) - image.begin - 1); }

[[noreturn]] void race(Kind kind, size_t size, const Area& area, int64_t at, Kind before, uint32_t code) {
  const Seen& seen = area.cells[at / area.unit].seen[before];
  char who[64];
  if (seen.by.block != place.block) {
    strcpy(who, "another block");
  } else if (seen.by.warp == kSeveral || seen.by.thread == kSeveral) {
    strcpy(who, "other threads");
  } else {
    snprintf(who, sizeof(who), "thread %d", seen.by.thread - 1);
  }
  fail("race: +%#x %s %d bytes of %s at byte %lld, %s by %s at +%#x without a barrier between", code, kVerb[kind],
       int(size), area.name, static_cast<long long>(at), kParticiple[before], who, seen.code);
}

// The area that has an address, or null.
Area* find(const char* address) {
  static size_t last = 0;
  if (last < areas.size() && address >= areas[last].begin && address < areas[last].end) return &areas[last];
  const auto after = std::upper_bound(areas.begin(), areas.end(), address,
                                      [](const char* it, const Area& area) { return it < area.begin; });
  if (after == areas.begin() || address >= after[-1].end) return nullptr;
  last = size_t(after - areas.begin()) - 1;
  return &areas[last];
}

[[noreturn]] void nowhere(Kind kind, size_t size, const char* address, uint32_t code) {
  const Area* nearest = nullptr;
  int64_t least = INT64_MAX, at = 0;
  for (const Area& area : areas) {
    const int64_t beyond = address < area.begin ? area.begin - address : address - area.end;
    if (beyond < least) least = beyond, nearest = &area, at = address - area.begin;
  }
  if (nearest == nullptr) fail("out of bounds: +%#x %s %d bytes; there is no memory", code, kVerb[kind], int(size));
  fail("out of bounds: +%#x %s %d bytes at byte %lld of the %lld of %s", code, kVerb[kind], int(size),
       static_cast<long long>(at), static_cast<long long>(nearest->end - nearest->begin), nearest->name);
}

void check_value(Kind kind, size_t size, Area& area, int64_t at, uint32_t code) {
  if (kind == kWrite) {
    if (area.written) memset(area.written + at, 1, size);
    return;
  }
  bool known = !area.written || !memchr(area.written + at, 0, size);
  for (int64_t i = at / area.unit; area.shared && i <= (at + int64_t(size) - 1) / area.unit; ++i)
    known &= area.cells[i].seen[kWrite].by.block != 0;
  if (!known)
    fail("uninitialised: +%#x %s %d bytes of %s at byte %lld, which have no value", code, kVerb[kind], int(size),
         area.name, static_cast<long long>(at));
}

}  // namespace

void access(Kind kind, const void* pointer, size_t size, const void* from) {
  if (stack.begin == nullptr || stack.has(pointer) || size == 0) return;
  const char* const address = static_cast<const char*>(pointer);
  const uint32_t code = offset(from);
  Area* const area = find(address);
  if (area == nullptr) {  // constants, and threadIdx and its like, which lie in this library
    if (kind == kRead && !shared.has(address) && (image.has(address) || own_image.has(address))) return;
    nowhere(kind, size, address, code);
  }
  if (int64_t(size) > area->end - address) nowhere(kind, size, address, code);
  const int64_t at = address - area->begin;
  if (size <= 16 && (size & (size - 1)) == 0 && uintptr_t(address) % size)
    fail("misaligned: +%#x %s %d bytes of %s at byte %lld", code, kVerb[kind], int(size), area->name,
         static_cast<long long>(at));
  check_value(kind, size, *area, at, code);
  for (int64_t i = at / area->unit; i <= (at + int64_t(size) - 1) / area->unit; ++i) {
    Cell& cell = area->cells[i];
    for (const Kind before : {kRead, kWrite, kAtomic}) {
      if (kind == before && kind != kWrite) continue;
      if (concurrent(cell.seen[before].by)) race(kind, size, *area, i * area->unit, before, code);
    }
    note(cell.seen[kind], code);
  }
}

void begin_launch(const Launch& launch) {
  areas.clear();
  image = launch.library.image;
  shared = {launch.library.shared_begin, launch.library.shared_end};
  for (const Tensor* it = launch.tensors_begin; it != launch.tensors_end; ++it)
    areas.push_back({it->name, it->data, it->data + it->bytes, it->unit, it->written, false, {}});
  for (const SharedVariable* it = launch.library.variables_begin; it != launch.library.variables_end; ++it)
    areas.push_back({it->name, it->data, it->data + it->bytes, kSharedUnit, nullptr, true, {}});
  std::sort(areas.begin(), areas.end(), [](const Area& one, const Area& two) { return one.begin < two.begin; });
  for (Area& area : areas) area.cells.resize((area.end - area.begin + area.unit - 1) / area.unit);
}

// Every block finds shared memory full of NaN.
void begin_block() {
  for (Area& area : areas)
    if (area.shared) {
      memset(area.begin, 0xff, size_t(area.end - area.begin));
      std::fill(area.cells.begin(), area.cells.end(), Cell{});
    }
}

}  // namespace emulation

using emulation::access;

#define CODE __builtin_return_address(0)
#define CHECK(size)                                                                          \
  void __tsan_read##size(void* at) { access(emulation::kRead, at, size, CODE); }             \
  void __tsan_write##size(void* at) { access(emulation::kWrite, at, size, CODE); }           \
  void __tsan_unaligned_read##size(void* at) { access(emulation::kRead, at, size, CODE); }   \
  void __tsan_unaligned_write##size(void* at) { access(emulation::kWrite, at, size, CODE); } \
  void __tsan_volatile_read##size(void* at) { access(emulation::kRead, at, size, CODE); }    \
  void __tsan_volatile_write##size(void* at) { access(emulation::kWrite, at, size, CODE); }

extern "C" {
CHECK(1)
CHECK(2)
CHECK(4)
CHECK(8)
CHECK(16)

void __tsan_init() {}
void __tsan_func_entry(void*) {}
void __tsan_func_exit() {}
void __tsan_read_range(void* at, size_t size) { access(emulation::kRead, at, size, CODE); }
void __tsan_write_range(void* at, size_t size) { access(emulation::kWrite, at, size, CODE); }

// Clang's names for what the compiler copies and fills.
void* __tsan_memcpy(void* to, const void* from, size_t size) {
  access(emulation::kRead, from, size, CODE), access(emulation::kWrite, to, size, CODE);
  return memcpy(to, from, size);
}
void* __tsan_memset(void* to, int value, size_t size) {
  access(emulation::kWrite, to, size, CODE);
  return memset(to, value, size);
}

// What the compiler passes of -fsanitize=bounds,alignment begins with the place in the source.
struct Source {
  const char* file;
  uint32_t line, column;
};
struct Mismatch {
  Source source;
  const void* type;
  unsigned char log_alignment, check;
};

void __ubsan_handle_out_of_bounds(Source* at, uintptr_t index) {
  emulation::fail("out of bounds: %s:%u uses index %lld of an array", at->file, at->line, (long long)(index));
}
void __ubsan_handle_type_mismatch_v1(Mismatch* it, uintptr_t address) {
  emulation::fail("misaligned: %s:%u uses an address that ends with %#x as one of %d bytes", it->source.file,
                  it->source.line, unsigned(address & 0xff), 1 << it->log_alignment);
}
}

// Faults of files and of the clock, for processes that load this library with LD_PRELOAD.
//
// CHAOS_CONTROL names a file that all of them map and that `shim.Control` writes: rules of the kind "calls of
// these sorts on files below this path fail with this error, or take so much longer", and an offset of the
// wall clock. Without an active rule a call costs one comparison more.

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <semaphore.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum { READ = 1, WRITE = 2, RULES = 4 };

// The layout of `shim._RULE` and `shim._HEAD`.
struct rule {
  int32_t calls;     // READ, WRITE or both; 0: the rule is off
  int32_t error;     // errno, 0: none
  int32_t delay_us;  // before the call
  int32_t left;      // how many calls it still applies to; negative: all
  char prefix[1008];
};

struct control {
  int64_t clock_ns;  // added to the wall clock
  int64_t on;        // whether any rule is
  struct rule rules[RULES];
};

static const struct control none;
static struct control* control;
static void* python;  // where the interpreter is loaded

static struct control* map(void) {
  const char* path = getenv("CHAOS_CONTROL");
  int (*real_open)(const char*, int, ...) = dlsym(RTLD_NEXT, "open");
  const int file = path ? real_open(path, O_RDWR | O_CLOEXEC) : -1;
  if (file < 0) return (struct control*)&none;
  void* mapped = mmap(NULL, sizeof(struct control), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  close(file);
  return mapped == MAP_FAILED ? (struct control*)&none : mapped;
}

static struct control* rules(void) {
  if (!control) control = map();
  return control;
}

static int below(const char* path, const char* prefix) {
  const size_t length = strlen(prefix);
  return !strncmp(path, prefix, length) && (path[length] == '/' || path[length] == 0);
}

// Waits and returns the error of the first rule that applies, 0 if none does.
static int fault(const char* path, int call) {
  struct control* all = rules();
  for (int i = 0; i < RULES; i++) {
    struct rule* rule = &all->rules[i];
    if (!(rule->calls & call) || !below(path, rule->prefix)) continue;
    if (rule->left >= 0 && __atomic_fetch_sub(&rule->left, 1, __ATOMIC_RELAXED) <= 0) {
      __atomic_store_n(&rule->left, 0, __ATOMIC_RELAXED);
      continue;
    }
    if (rule->delay_us) usleep((useconds_t)rule->delay_us);
    if (rule->error) return rule->error;
  }
  return 0;
}

// The same for a file that is open.
static int fault_of(int file, int call) {
  if (!rules()->on) return 0;
  const int before = errno;
  char name[32], path[PATH_MAX];
  snprintf(name, sizeof name, "/proc/self/fd/%d", file);
  const ssize_t length = readlink(name, path, sizeof path - 1);
  errno = before;
  if (length <= 0 || path[0] != '/') return 0;
  path[length] = 0;
  return fault(path, call);
}

// The same for one that is opened to be read. A full disk does not keep a file from being opened or made.
static int fault_at(const char* path, int flags) {
  if (!rules()->on || (flags & O_ACCMODE) != O_RDONLY || flags & O_DIRECTORY) return 0;
  char absolute[PATH_MAX];
  if (path[0] != '/') {
    if (!getcwd(absolute, sizeof absolute)) return 0;
    const size_t length = strlen(absolute);
    snprintf(absolute + length, sizeof absolute - length, "/%s", path);
    path = absolute;
  }
  const int before = errno;
  const int error = fault(path, READ);
  errno = before;
  return error;
}

#define REAL(name) \
  static __typeof__(name)* real; \
  if (!real) real = (__typeof__(name)*)dlsym(RTLD_NEXT, #name)

#define FAIL_IF(expression) \
  do { \
    const int failed = expression; \
    if (failed) { \
      errno = failed; \
      return -1; \
    } \
  } while (0)

#define OPEN(name) \
  int name(const char* path, int flags, ...) { \
    REAL(name); \
    va_list more; \
    va_start(more, flags); \
    const mode_t mode = va_arg(more, mode_t); \
    va_end(more); \
    FAIL_IF(fault_at(path, flags)); \
    return real(path, flags, mode); \
  }

#define OPENAT(name) \
  int name(int folder, const char* path, int flags, ...) { \
    REAL(name); \
    va_list more; \
    va_start(more, flags); \
    const mode_t mode = va_arg(more, mode_t); \
    va_end(more); \
    if (folder == AT_FDCWD || path[0] == '/') FAIL_IF(fault_at(path, flags)); \
    return real(folder, path, flags, mode); \
  }

#define TRANSFER(name, call, pointer) \
  ssize_t name(int file, pointer data, size_t count) { \
    REAL(name); \
    FAIL_IF(fault_of(file, call)); \
    return real(file, data, count); \
  }

#define TRANSFER_AT(name, call, pointer, offset) \
  ssize_t name(int file, pointer data, size_t count, offset start) { \
    REAL(name); \
    FAIL_IF(fault_of(file, call)); \
    return real(file, data, count, start); \
  }

#define TRANSFER_PARTS(name, call) \
  ssize_t name(int file, const struct iovec* parts, int count) { \
    REAL(name); \
    FAIL_IF(fault_of(file, call)); \
    return real(file, parts, count); \
  }

#define FLUSH(name) \
  int name(int file) { \
    REAL(name); \
    FAIL_IF(fault_of(file, WRITE)); \
    return real(file); \
  }

OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)
TRANSFER(read, READ, void*)
TRANSFER(write, WRITE, const void*)
TRANSFER_AT(pread, READ, void*, off_t)
TRANSFER_AT(pread64, READ, void*, off64_t)
TRANSFER_AT(pwrite, WRITE, const void*, off_t)
TRANSFER_AT(pwrite64, WRITE, const void*, off64_t)
TRANSFER_PARTS(readv, READ)
TRANSFER_PARTS(writev, WRITE)
FLUSH(fsync)
FLUSH(fdatasync)

// Nanoseconds to add to the clock for this caller. It is Python alone that gets another time: other code
// passes absolute times to the kernel, whose clock is as it was.
static int64_t jump(void* caller) {
  const int64_t offset = rules()->clock_ns;
  if (!offset) return 0;
  Dl_info found;
  if (!python) {
    void* symbol = dlsym(RTLD_DEFAULT, "Py_Initialize");
    if (!symbol || !dladdr(symbol, &found)) return 0;
    python = found.dli_fbase;
  }
  return dladdr(caller, &found) && found.dli_fbase == python ? offset : 0;
}

static void add(struct timespec* when, int64_t offset) {
  const int64_t sum = (int64_t)when->tv_sec * 1000000000 + when->tv_nsec + offset;
  when->tv_sec = sum / 1000000000;
  when->tv_nsec = sum % 1000000000;
}

int clock_gettime(clockid_t clock, struct timespec* now) {
  REAL(clock_gettime);
  const int result = real(clock, now);
  if (!result && clock == CLOCK_REALTIME) add(now, jump(__builtin_return_address(0)));
  return result;
}

int gettimeofday(struct timeval* restrict now, void* restrict zone) {
  REAL(gettimeofday);
  const int result = real(now, zone);
  if (!result) now->tv_sec += jump(__builtin_return_address(0)) / 1000000000;
  return result;
}

time_t time(time_t* now) {
  REAL(time);
  const time_t seconds = real(NULL) + jump(__builtin_return_address(0)) / 1000000000;
  if (now) *now = seconds;
  return seconds;
}

int sem_timedwait(sem_t* restrict semaphore, const struct timespec* restrict until) {
  REAL(sem_timedwait);
  struct timespec kernels = *until;
  add(&kernels, -jump(__builtin_return_address(0)));
  return real(semaphore, &kernels);
}

"""Decides and shows: runs as data, the engine that trains them, what looks at them, and the command line."""

import os

# Read by Ray when it is imported: nothing is sent anywhere, and a machine without GPU is no reason to warn.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
# Read by the C library when a worker starts: each of the arenas that Ray's many threads would get keeps what
# decoding has taken once, so that a worker grew with every task. Two are the trainer's and everybody else's.
os.environ.setdefault("MALLOC_ARENA_MAX", "2")

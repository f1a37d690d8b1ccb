"""Decides and shows: configuration, run state, the Ray driver, preflight, the command line."""

import os

# Read by Ray when it is imported: nothing is sent anywhere, and a machine without GPU is no reason to warn.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")

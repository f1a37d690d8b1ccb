"""Decides and shows: configuration, run state, the Ray driver, preflight, the command line."""

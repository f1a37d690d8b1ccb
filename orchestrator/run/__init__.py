"""A run as data: settings, records, state, files. Imports neither torch nor Ray."""

"""A run as data: settings, records, state, files, stores, machines, money. Imports neither torch nor Ray."""

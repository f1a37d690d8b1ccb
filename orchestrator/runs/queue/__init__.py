"""A queue of runs for one machine, or for the head of one cluster. Imports neither torch nor Ray."""

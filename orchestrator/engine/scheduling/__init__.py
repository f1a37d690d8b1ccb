"""Which tasks start now and where, which places to avoid, how many machines to have. Decisions, no Ray."""

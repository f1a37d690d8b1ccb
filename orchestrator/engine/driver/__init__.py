"""The driver, the only writer of a run folder."""

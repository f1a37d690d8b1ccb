"""Three days of a large run in minutes: the real driver, simulated machines that fail, a clock that jumps."""

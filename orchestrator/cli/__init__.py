"""The options and commands of `panolog`."""

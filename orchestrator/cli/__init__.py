"""The command line: options and commands of `panolog`, by subject."""

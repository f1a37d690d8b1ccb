"""The dashboard of a very large run."""

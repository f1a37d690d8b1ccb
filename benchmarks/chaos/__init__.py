"""Runs under random SIGKILLs."""

"""Passers-by in panoramas of an empty place: what they cost, and how many of them are found."""

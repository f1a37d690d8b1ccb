"""Passers-by in panoramas of a place where nobody is: what they cost, and how many of them are found."""

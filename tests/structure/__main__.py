"""Prints every violation of every rule, and how many there are."""

from tests.structure.rules import RULES

for rule in RULES:
    violations = list(rule())
    print(f"\n== {rule.__name__}: {len(violations)}", *violations, sep="\n")

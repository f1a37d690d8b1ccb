"""The rules of the tree, measured on the code itself: `python -m tests.structure` prints every violation."""

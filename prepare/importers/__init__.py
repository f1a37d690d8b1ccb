"""Scenes of other programs, read and written as a scene of ours: one module for each format.

Each module's docstring states the convention of its format and where that was learned: axes, which way a pose
maps, units, where pixels have their centre, handedness, and what lies at longitude 0 (the middle column).
"""

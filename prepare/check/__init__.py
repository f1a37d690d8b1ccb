"""Checks that poses, points and panoramas of a scene fit, before time is spent on training."""

"""Panoramas that are added to a finished scene: posed against it, while nothing in it moves."""

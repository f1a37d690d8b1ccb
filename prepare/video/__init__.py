"""Frames of a 360° video that a reconstruction wants: sharp ones, an even baseline apart."""

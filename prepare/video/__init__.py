"""Frames of a 360° video for a reconstruction: sharp ones, an even baseline apart."""

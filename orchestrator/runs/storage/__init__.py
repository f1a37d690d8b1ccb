"""Runs in object stores: a mirror next to the driver copies a run out, and a new head brings it back.

The driver is the only writer of the local folder. The mirror reads it, and writes RUN/store/ alone.
"""

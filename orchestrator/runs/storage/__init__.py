"""Runs in object stores: a mirror next to the driver copies a run out, and a new head brings it back.

The run itself lives in a local folder, of which the driver is the only writer. The mirror reads it, and
writes RUN/store/ alone. docs/storage.md says what is in a store, in which order it gets there, and what that
costs.
"""

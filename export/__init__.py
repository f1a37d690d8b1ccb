"""Models as files that others open: small, streamed, and georeferenced. Nothing here trains or renders."""

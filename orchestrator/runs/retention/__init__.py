"""What of a run may be removed once something else stands for it, and its removal."""

"""What each command does: wires the parts of a run together."""

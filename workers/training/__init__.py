"""Training of one task: Stage I and the refinement of a block."""

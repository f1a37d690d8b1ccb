"""What machines cost, and how much of it a run may use."""

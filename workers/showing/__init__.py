"""What a task in training shows of itself."""

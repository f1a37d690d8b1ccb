"""What a run costs, as its records say it."""

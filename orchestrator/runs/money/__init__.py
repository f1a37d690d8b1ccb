"""What machines cost, how much of it a run may use, and what it has cost as its records say it."""

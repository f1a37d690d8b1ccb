"""What limits of cost and time do to a run."""

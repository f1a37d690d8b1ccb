"""What machines have, and where on them tasks run."""

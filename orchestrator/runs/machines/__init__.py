"""What machines are: what there is, settings, and what the records of a run say of each."""

"""The queue on the page of all runs."""

"""All that uses Ray."""

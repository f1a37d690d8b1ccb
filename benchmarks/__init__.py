"""What is fast and what is good, measured: every claim about performance or quality is a command here."""

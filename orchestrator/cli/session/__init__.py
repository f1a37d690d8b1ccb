"""A run as a process: its session, its supervisor, what is next to it, what it prepares and delivers."""

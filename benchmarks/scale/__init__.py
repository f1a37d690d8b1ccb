"""How needs grow with a place: laws, the driver, models on disk, and which machine for how long."""

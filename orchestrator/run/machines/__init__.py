"""The machines of a run: its settings of them, and what its records say of each."""

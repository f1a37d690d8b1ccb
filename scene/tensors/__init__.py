"""Tensors that are large: several as one block of memory, and on their way to a GPU."""

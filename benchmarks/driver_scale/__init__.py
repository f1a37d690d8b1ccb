"""The driver with very many blocks and workers."""

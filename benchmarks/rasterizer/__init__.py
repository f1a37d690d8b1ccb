"""The rasterizer: what an iteration costs and what it is made of."""

"""Gaussians in glTF and 3D Tiles, for globes and engines."""

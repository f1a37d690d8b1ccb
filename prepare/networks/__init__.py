"""Depth maps, sky masks and masks of movers, by ONNX networks."""

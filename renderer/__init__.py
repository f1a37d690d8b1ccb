"""The differentiable equirectangular (ERP) rasterizer and the losses that need kernels."""

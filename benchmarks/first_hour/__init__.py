"""Everything that a machine with an NVIDIA card can show about the CUDA kernels, unattended in 25 minutes."""

"""The ops on a GPU: what each launches, its kernels compiled by NVRTC, and the card that they run on."""

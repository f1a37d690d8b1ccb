"""Places whose facades repeat, with exact poses: what structure from motion is misled by.

`layouts` says what stands where and how the camera walks, `shoot` ray-casts the panoramas.
"""

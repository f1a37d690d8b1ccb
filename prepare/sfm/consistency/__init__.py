"""Which pairs of panoramas show the same place, and which two places that only look alike.

`evidence` says how much of the sphere a pair shares, `skeleton` which pairs carry the reconstruction,
`agreement` whether other pairs fit it, `verdict` whether the result can be trusted.
"""

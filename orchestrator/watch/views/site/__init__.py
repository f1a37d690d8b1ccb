"""The page of a model in 3D: what it is made of, and from where it is looked at."""

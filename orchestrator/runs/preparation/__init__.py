"""What is in RUN/prepare: how a run of panoramas or of a video makes its scene, and how far it is."""

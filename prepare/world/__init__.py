"""The frame of a reconstruction: what files say of gravity and GPS, and the similarity that follows."""

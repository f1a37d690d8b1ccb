"""Seams: what a viewer would notice along the faces between the blocks of a merged model."""

"""What a scene is and how it is read and written: panoramas, poses, masks, depth, Gaussians, PLY."""

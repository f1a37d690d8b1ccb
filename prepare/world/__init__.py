"""The world frame of a reconstruction, from gravity and GPS in the files of its panoramas."""

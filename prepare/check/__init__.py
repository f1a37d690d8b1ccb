"""Do poses, points and panoramas of a scene belong together? Asked before a day of training finds out."""

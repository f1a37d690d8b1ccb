"""From panoramas alone to a scene: poses and points by structure from motion."""

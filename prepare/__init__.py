"""All that makes a scene: importers, structure from motion, videos, world frames, checks, networks."""

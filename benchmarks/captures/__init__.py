"""Scenes as real cameras capture them, made of a scene without fault, and what is lost by that."""

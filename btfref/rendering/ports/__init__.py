"""Representations for renderers that are not ours: a shader, its textures, and answers to check them by."""

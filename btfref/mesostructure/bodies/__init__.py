"""Closed bodies over a plane: rings, grains, blisters and plates."""

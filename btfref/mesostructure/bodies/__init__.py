"""Closed bodies over a plane: rings, grains, drops and plates."""

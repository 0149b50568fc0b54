"""Readers of meshes: triangles with everything that their materials ask of them."""

"""Laplacian pyramid of a BTF with principal components per level."""

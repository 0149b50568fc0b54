"""Fitting: low rank, clusters, factors, least squares; and how many threads BLAS gets."""

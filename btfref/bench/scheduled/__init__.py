"""Builds and errors of a plan by the workers of a Dask cluster."""

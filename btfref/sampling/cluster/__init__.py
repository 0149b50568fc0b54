"""Tasks of a Dask cluster, whatever they make."""

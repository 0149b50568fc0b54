"""Files of queries: the Zarr store that is filled and resumed, and what is made of it for other readers."""

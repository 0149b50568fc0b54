"""The Zarr store of a sampled BTF: its files, its parts, and how a run resumes."""

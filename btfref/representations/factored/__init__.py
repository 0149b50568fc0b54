"""Methods that are products of maps of single directions: `cmf`, `hf`."""

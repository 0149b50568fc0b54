"""A latent texture and a small network (`neural`)."""

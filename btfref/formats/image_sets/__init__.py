"""BTFs as one picture per pair of directions: UBO, UTIA, SPECTRAL."""

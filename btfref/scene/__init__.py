"""What a scene is, what its camera sees, and what it needs of a BTF."""

"""Commands that make representations, and make them better."""

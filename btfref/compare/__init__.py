"""Image comparison: metrics, statistics and gates."""

"""Methods that keep tables over both directions: `raw`, `svd`, `lpca`."""

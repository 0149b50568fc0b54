"""What the derivatives of maps are worth: whether they are right, and how far they take a fit."""

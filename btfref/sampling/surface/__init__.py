"""The shared estimator: surface points whose visibility serves all views and all lights."""

"""The reference estimator: paths from the view side, shared by all lights."""

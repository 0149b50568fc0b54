"""Functions of directions: sets, interpolation, quadrature, maps and frames."""

"""Ways to interpolate between measured views; read without NumPy, for help texts."""

#: All views around a view, or one of them that is drawn.
INTERPOLATIONS = ("blended", "drawn")

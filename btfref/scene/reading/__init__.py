"""What scenes are read with: shapes that are drawn more than once, and what is refused."""

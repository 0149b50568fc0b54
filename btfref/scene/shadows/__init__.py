"""Cast shadows: what can stand between a light and a surface, and where renderers may differ about it."""

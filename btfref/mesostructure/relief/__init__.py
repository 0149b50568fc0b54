"""Height fields without overhang: one periodic grid of heights each."""

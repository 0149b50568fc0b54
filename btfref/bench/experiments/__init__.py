"""Experiments: one question of one method each."""

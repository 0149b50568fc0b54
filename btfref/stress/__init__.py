"""Numerical stability: every method and every evaluator under hard lookups and hard data."""

"""Lights of a scene as data: what each brings to a point, and points that stand for area lights."""

"""Yarns and fibres: tubes that cross, loop or stand."""

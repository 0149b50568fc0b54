"""Compressed representations: one module per method, one file format for all."""

from btfref.representations.file.container import load, read_info, save

__all__ = ["load", "read_info", "save"]

"""Scenes that btfref ships: Mitsuba XML beside its meshes, made to be read and edited."""

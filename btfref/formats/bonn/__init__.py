"""Bonn's binary BTFs: DFMF, FMF, PVF and BDI."""

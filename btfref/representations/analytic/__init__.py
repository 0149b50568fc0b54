"""Methods that store functions of the light: `rf_poly`, `rf_lobes`, `lafortune`, `lafortune_lut`."""

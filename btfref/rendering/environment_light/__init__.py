"""Light from environments: prefiltered maps, harmonics, transfer, sets of lights; for shaders and in float64."""

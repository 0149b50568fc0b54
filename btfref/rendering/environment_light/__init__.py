"""Light from environments: prefiltered maps, harmonics, transfer, sets of lights; for shaders and in float64."""

#: Names of the ways in which an environment lights, here so that a command line knows them without loading NumPy.
#: "auto" is "prefiltered" where the method has it, else "lights".
PATHS = ("auto", "prefiltered", "lights", "sh", "transfer")

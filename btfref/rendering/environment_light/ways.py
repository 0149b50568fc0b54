"""Names of the ways in which an environment lights, apart, so that a command line knows them without loading NumPy."""

#: "auto" is "prefiltered" where the method has it, else "lights".
PATHS = ("auto", "prefiltered", "lights", "sh", "transfer")

"""Pictures that are right before they are fast: Mitsuba, and definitions in float64."""

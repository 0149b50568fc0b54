"""The split between what is fitted and what is judged: places and directions that no fit sees. Read without NumPy."""

#: Seed of the rows that no fit sees: the split between what is fitted and what is judged.
SPLIT = 1_618_033

#: Largest polar angle, degrees.
MAX_THETA = 85.0

#: Footprints by name: half sides of squares, in texels of the fits.
FOOTPRINTS = {"point": 0.0, "texel": 0.5, "4 x 4 texels": 2.0}

#: The footprint that short tables show.
SHOWN = "texel"

#: Rows of each footprint, samples of each half of a row, and lookups that a method averages over a footprint.
#: Highlights are rare: many rows of few samples say more than few rows of many.
ROWS, SPP, LOOKUPS = 20_000, 64, 4

#: Rows where less is asked for.
QUICK_ROWS, QUICK_SPP = 500, 32

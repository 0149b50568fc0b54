"""Known faults: which there are, where they are looked for, and those that edit code."""

"""The file of a representation: one multi-part OpenEXR, read whole or by need."""

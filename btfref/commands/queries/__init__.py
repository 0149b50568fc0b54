"""The commands that ask a surface, or a method, at random places and directions."""

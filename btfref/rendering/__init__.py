"""Rendering: offline by Mitsuba, in real time by OpenGL, and light from environments for both."""

"""Reading scenes and rendering them: the Mitsuba reference, the real-time renderer and the GLSL composer."""

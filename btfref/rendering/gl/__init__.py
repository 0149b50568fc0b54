"""OpenGL without a window: device, shader composer, rasterizer, probe, renderer."""

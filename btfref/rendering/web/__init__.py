"""The same shaders in a browser: Chromium without a window, WebGL 2, numbers read back as floats."""

"""Images and exact depth of a room by OpenGL, without a display."""

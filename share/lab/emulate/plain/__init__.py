"""The plain room, which needs no OpenGL."""

"""The live room: a 3D view of the shared map in a browser, drawn by a process of its own (extra view)."""

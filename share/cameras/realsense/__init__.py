"""Intel RealSense cameras by their SDK."""

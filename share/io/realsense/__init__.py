"""Intel RealSense D4xx by pyrealsense2: found, opened, read. Only here the SDK is touched."""

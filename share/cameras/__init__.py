"""Live cameras: samples as they come, with a watchdog; `realsense` is the one kind so far."""

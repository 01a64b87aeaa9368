"""Motion capture: its files, its clock, its mounting; ground truth of a device from it and the IMU."""

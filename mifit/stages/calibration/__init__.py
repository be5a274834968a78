"""Parts of the dense calibration: tracks of surface points through the images, and their bundle adjustment."""

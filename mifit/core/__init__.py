"""Plain NumPy parts that know nothing of Mitsuba: cameras, images, meshes, UV maps, harmonics, metrics."""

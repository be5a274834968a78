"""Stage 3: normals per timestep that explain the images, and meshes that carry them as shape."""

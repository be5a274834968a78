"""The stages: inputs + config + seed -> estimate. Data flows geometry -> reflectance -> normals."""

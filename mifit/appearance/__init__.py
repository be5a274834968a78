"""Image formation: the only place that knows how light, surface and lobe make an image.

`illumination` and `lobe` are NumPy records, `models` the shading models in their registry, `occlusion` traced shadows,
`formation` what puts them together, `environment` a whole environment map, and `kernels` the Dr.Jit functions they
share.
"""

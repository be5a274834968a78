"""Image formation: the only place that knows how light, surface and lobe make an image.

`illumination` and `lobe` are NumPy records, `models` the shading models in their registry, `occlusion` traced shadows,
`image` what puts them together, `kernels` the Dr.Jit functions they share and `reference` the plain float64 forms that
tests compare with.
"""

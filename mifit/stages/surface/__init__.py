"""Parts of stage 1b: the surface that all images together ask for, beyond the model's span."""

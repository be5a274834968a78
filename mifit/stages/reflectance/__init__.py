"""The parts of stage 2: lighting, maps, smoothness and the choice of the shading model."""

"""Synthetic captures with ground truth: subjects outside the span of what is fitted, rendered by path tracing."""

from mifit.synth.compose import synthesize as synthesize

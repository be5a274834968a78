"""Nonlinear least squares; knows nothing of faces or rendering."""

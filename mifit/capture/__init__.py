"""Captures: synchronised images of a head, their calibration, landmarks and masks."""

from mifit.capture.capture import Capture as Capture
from mifit.capture.capture import Frame as Frame

__all__ = ["Capture", "Frame"]

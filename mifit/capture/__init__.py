"""Captures: synchronised images of a head, their calibration, landmarks and masks."""

from mifit.capture.capture import Capture as Capture
from mifit.capture.capture import Frame as Frame
from mifit.capture.detect import detect_landmarks as detect_landmarks
from mifit.capture.importer import import_capture as import_capture

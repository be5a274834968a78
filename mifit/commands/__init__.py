"""What each ``mifit`` command does, given its parsed arguments. Raises InputError for bad input."""

from mifit.commands.captures import calibrate, import_, landmarks, synth
from mifit.commands.fits import demo, fit, run, track
from mifit.commands.inspection import doctor, model
from mifit.commands.results import evaluate, export, relight, render, turntable, view

__all__ = [
    "calibrate",
    "demo",
    "doctor",
    "evaluate",
    "export",
    "fit",
    "import_",
    "landmarks",
    "model",
    "relight",
    "render",
    "run",
    "synth",
    "track",
    "turntable",
    "view",
]

"""Scene-file driven experiments: runs, sweeps of them, their tables and plots."""

from mifit.experiments.plan import Plan, Run, load_plan
from mifit.experiments.run import finished, run_experiment

__all__ = ["Plan", "Run", "finished", "load_plan", "run_experiment"]

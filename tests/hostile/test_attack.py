"""The attack suite in reduced form; ``make attack`` runs all of it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EVERY = 40


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="forks, and limits processes as Linux does")
def test_every_fortieth_attack_is_refused_in_one_line_and_changes_nothing(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    command = [sys.executable, "-m", "tests.hostile.attack", "--every", str(EVERY), "--json", str(report)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert report.exists(), done.stderr[-2000:]
    found = json.loads(report.read_text())
    assert found["wrong"] == {}, done.stdout
    assert found["cases"] >= 70 and found["refused"] >= 60

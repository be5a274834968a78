"""Kill commands at random moments and fill the disk under them: nothing is lost, and resumed results are identical.

``python -m tests.hostile.endure [--part N]`` runs 100 kills and 50 full disks (``--part 10``: a tenth of them) on a
capture of 120 x 90 pixels. Commands run in processes forked from this one. Half of the kills come at a moment of the
clock, half at one of the changes of files that the command makes (a file opened for writing, renamed, removed; a folder
made or removed): those are the moments that matter. A full disk is a limit on the size of files, at a random byte.
After each:

- what was there before is whole: as it was, or as an unbroken run leaves it, file by file, and never mixed;
- a command that found no room ends with exit code 2 and one line;
- the command run again, with ``--resume`` where it has that, ends with what an unbroken run gives, bit for bit, and no
  temporary file is left. Times, memory and the report, which shows them, aside.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mifit.result.ownership import finish as finish_writing
from tests.hostile.attack import preload
from tests.hostile.child import run_command

CHANGES = {"os.remove", "os.rename", "os.mkdir", "os.rmdir", "shutil.rmtree"}
FIT = ("fit", "capture", "--model", "builtin:coarse", "--timesteps", "0", "--config", "fit.toml", "--quiet")
CONFIG = """
[geometry]
rounds = 1
max_iterations = 2
pixels = 200
[surface]
enabled = false
[reflectance]
texture_size = 16
bands = 3
shading = "prefiltered"
exponent = 20.0
max_iterations = 2
[normals]
max_iterations = 2
"""
"""A fit that takes two seconds: what is tested is files."""
EXPERIMENT = (
    'name = "e"\n[fit]\ncapture = "capture"\nmodel = "builtin:coarse"\ntimesteps = [0]\nuntil = "geometry"\n'
    "[fit.geometry]\nrounds = 1\nmax_iterations = 2\n[fit.surface]\nenabled = false\n"
    '[evaluate]\ncamera = "third"\n[sweep.grid]\n"fit.seed" = [0, 1]\n'
)


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code (negative: the signal), changes of files counted, seconds, standard error."""

    code: int
    changes: int
    seconds: float
    error: str


def run(
    work: Path,
    arguments: tuple[str, ...],
    after_changes: int | None = None,
    after_seconds: float | None = None,
    room: int | None = None,
) -> Ended:
    """Run a command in a forked process; kill it and all that it started after so many changes or seconds."""
    counted, start = work.parent / "changes", time.monotonic()
    counted.write_text("0")
    (work.parent / "stderr").write_text("")
    sys.stdout.flush()
    process = os.fork()
    if process == 0:
        _child(work, arguments, counted, after_changes, room)
    while True:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            break
        if after_seconds is not None and time.monotonic() - start > after_seconds:
            try:
                os.killpg(process, signal.SIGKILL)
            except ProcessLookupError:  # it leads no group yet
                os.kill(process, signal.SIGKILL)
            status = os.waitpid(process, 0)[1]
            break
        time.sleep(0.01)
    code = os.waitstatus_to_exitcode(status)
    return Ended(code, int(counted.read_text() or 0), time.monotonic() - start, (work.parent / "stderr").read_text())


def _child(work: Path, arguments: tuple[str, ...], counted: Path, after: int | None, room: int | None) -> None:
    """Never returns."""
    os.setsid()

    def prepare() -> None:
        os.chdir(work)
        count, descriptor = 0, os.open(counted, os.O_WRONLY)

        def hook(event: str, values: tuple) -> None:
            nonlocal count
            opened = event == "open" and isinstance(values[2], int) and values[2] & (os.O_WRONLY | os.O_RDWR)
            if opened or event in CHANGES:
                count += 1
                os.pwrite(descriptor, str(count).encode(), 0)
                if count == after:
                    os.killpg(0, signal.SIGKILL)

        sys.addaudithook(hook)
        if room is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    run_command(work.parent, arguments, prepare)


def content(place: Path) -> dict[str, bytes]:
    """Files of a folder, or one file, that a user sees, without what differs between two equal runs."""
    if place.is_file():
        return {place.name: place.read_bytes()}
    found = {}
    for path in sorted(place.rglob("*")):
        name = str(path.relative_to(place))
        if (
            path.is_dir()
            or name.startswith(".mifit")
            or "/.mifit" in name
            or path.name in ("report.html", "summary.md")
            or path.parent.name == "stages"  # holds times
            or "seconds" in path.name
        ):
            continue
        data = path.read_bytes()
        if path.suffix == ".json":
            data = json.dumps(_untimed(json.loads(data)), sort_keys=True).encode()
        found[name] = data
    return found


def _untimed(value: object) -> object:
    if isinstance(value, dict):
        return {k: _untimed(v) for k, v in value.items() if "seconds" not in k and k != "peak_memory"}
    return [_untimed(v) for v in value] if isinstance(value, list) else value


@dataclass(frozen=True)
class Scenario:
    """A command, what lies in its folder before, and where its output is.

    ``prepare`` sets the working folder up; ``again`` is the command that goes on after a break. With ``whole`` the old
    output must be there unchanged until the new one is, all of it; else file by file.
    """

    name: str
    command: tuple[str, ...]
    output: str
    kills: int
    fulls: int
    prepare: Callable[[Path], None]
    again: tuple[str, ...] | None = None
    whole: bool = False
    clock_only: bool = False


def scenarios(base: Path) -> list[Scenario]:
    """All of them; ``base`` holds a capture, a fit of it and another one."""

    def copy(*names: str) -> Callable[[Path], None]:
        def prepare(work: Path) -> None:
            for name in names:
                source = base / name
                if source.is_dir():
                    shutil.copytree(source, work / name)
                else:
                    shutil.copy(source, work / name)

        return prepare

    def over(*names: str) -> Callable[[Path], None]:
        def prepare(work: Path) -> None:
            copy(*names)(work)
            shutil.copytree(base / "other", work / "out")

        return prepare

    def exported(name: str, kind: str, suffix: str) -> Scenario:
        command = ("export", "result", "--format", kind, "--out", f"x/f.{suffix}")
        return Scenario(f"export {name}", command, "x", 8, 4, copy("result"), (*command, "--force"))

    given = ("capture", "fit.toml")
    track = ("track", "capture", "--result", "result", "--timesteps", "1", "--quiet")
    return [
        Scenario("fit", (*FIT, "--out", "out"), "out", 22, 10, copy(*given), (*FIT, "--out", "out", "--resume")),
        Scenario("fit over", (*FIT, "--out", "out", "--force"), "out", 14, 8, over(*given), whole=True),
        Scenario("track", track, "result", 22, 10, copy("capture", "result"), (*track, "--resume")),
        exported("glb", "glb", "glb"),
        exported("obj", "obj", "obj"),
        exported("scene", "mitsuba", "xml"),
        Scenario(
            "import", ("import", "--transforms", "capture/transforms.json", "--out", "out", "--quiet"), "out", 12, 6,
            copy("capture"), whole=True,
        ),
        Scenario(
            "run", ("run", "e.toml", "--out", "out", "--quiet"), "out", 6, 4, copy("capture", "e.toml"), clock_only=True
        ),
    ]  # fmt: skip


def make_base(base: Path) -> None:
    """A small capture and two fits of it."""
    base.mkdir()
    (base / "fit.toml").write_text(CONFIG)
    (base / "e.toml").write_text(EXPERIMENT)
    size = (
        "--timesteps",
        "2",
        "--width",
        "120",
        "--height",
        "90",
        "--spp",
        "4",
        "--model",
        "builtin:coarse",
        "--quiet",
    )
    for arguments in (
        ("synth", "--out", "capture", *size),
        (*FIT, "--out", "result"),
        (*FIT, "--out", "other", "--seed", "7"),
    ):
        ended = run(base, arguments)
        if ended.code:
            raise SystemExit(f"{arguments}: {ended.error}")


class Broken(Exception):
    """Something was lost, mixed or left."""


def judge(old: dict[str, bytes], now: dict[str, bytes], new: dict[str, bytes], scenario: Scenario) -> None:
    """What lies there after a break must be old or new, file by file; with ``whole`` all of one kind."""
    now = {name: data for name, data in now.items() if ".part" not in name}
    if scenario.whole:
        if now not in (old, new):
            names = [n for n in {*now, *old, *new} if not (now.get(n) == old.get(n) or now.get(n) == new.get(n))]
            raise Broken(f"neither as before nor as after: {names[:4] or sorted(set(old) ^ set(now))[:4]}")
        return
    for name, data in now.items():
        if name.endswith(("result.json", "summary.json")):
            continue  # grows by a timestep or a run at a time: judged at the end
        if data not in (old.get(name), new.get(name)):
            raise Broken(f"{name} is neither as before nor as after")
    lost = [name for name in old if name not in now and name in new]
    if lost:
        raise Broken(f"{lost[0]} is gone")


def endure(scenario: Scenario, root: Path, kills: int, fulls: int, chance: random.Random) -> tuple[int, int]:
    """Break one command again and again; returns how many kills and full disks there were."""

    def fresh() -> Path:
        shutil.rmtree(root, ignore_errors=True)
        (root / "work").mkdir(parents=True)
        scenario.prepare(root / "work")
        return root / "work"

    work = fresh()
    output = work / scenario.output
    old = content(output) if output.exists() else {}
    unbroken = run(work, scenario.command)
    if unbroken.code:
        raise Broken(f"unbroken: exit {unbroken.code}: {unbroken.error}")
    new = content(output)
    largest = max(p.stat().st_size for p in output.rglob("*") if p.is_file())

    def finish() -> None:
        ended = run(work, scenario.again or scenario.command)
        if ended.code:
            raise Broken(f"run again: exit {ended.code}: {ended.error}")
        now = content(output)
        if now != new:
            raise Broken(f"run again: differs in {[n for n in {*now, *new} if now.get(n) != new.get(n)][:5]}")
        left = [p for p in work.rglob("*") if ".part" in p.name]
        if left:
            raise Broken(f"run again: {left[0].name} is left")

    done, seconds = 0, unbroken.seconds
    work = fresh()
    while done < kills:
        command = scenario.command if not output.exists() else (scenario.again or scenario.command)
        if scenario.clock_only or done % 2:
            ended = run(work, command, after_seconds=chance.uniform(0.05, 0.95) * seconds)
        else:
            ended = run(work, command, after_changes=chance.randint(1, max(unbroken.changes, 1)))
        if ended.code != -signal.SIGKILL:  # it had less left to do: it ended before its moment
            if ended.code:
                raise Broken(f"going on: exit {ended.code}: {ended.error}")
            work = fresh()
            continue
        done += 1
        if (output / ".mifit").is_dir():
            finish_writing(output)  # as whoever writes into the folder next does first
        if output.exists() or old:
            judge(old, content(output) if output.exists() else {}, new, scenario)
        if done % 4 == 0 or done == kills:
            finish()
            work = fresh()
    for _ in range(fulls):
        work = fresh()
        ended = run(work, scenario.command, room=chance.randint(0, largest - 1))
        lines = [line for line in ended.error.splitlines() if not line.startswith(("mifit: warning", "mifit: fault"))]
        if ended.code != 2 or len(lines) != 1:
            raise Broken(f"no room: exit {ended.code} with {len(lines)} lines: {ended.error[-600:]}")
        judge(old, content(output) if output.exists() else {}, new, scenario)
        finish()
    return done, fulls


def main() -> int:
    """Command line; exit code 1 when something was lost, mixed or left."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", type=int, default=1, help="an N-th of the kills and full disks")
    parser.add_argument("--only", default="", help="commands whose names hold this text")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the counts to a file")
    arguments = parser.parse_args()
    preload()
    wrong: dict[str, str] = {}
    counts: dict[str, dict[str, int]] = {}
    with tempfile.TemporaryDirectory(prefix="endure-") as name:
        root = Path(name)
        make_base(root / "base")
        for scenario in scenarios(root / "base"):
            if arguments.only not in scenario.name:
                continue
            kills, fulls = (-(-n // arguments.part) for n in (scenario.kills, scenario.fulls))
            start = time.monotonic()
            try:
                chance = random.Random(f"{arguments.seed} {scenario.name}")
                done = endure(scenario, root / "case", kills, fulls, chance)
                counts[scenario.name] = {"kills": done[0], "full_disks": done[1]}
                seconds = time.monotonic() - start
                print(f"{scenario.name:<16}{done[0]:>4} kills{done[1]:>4} full disks  {seconds:.0f} s", flush=True)
            except Broken as error:
                wrong[scenario.name] = str(error)
                print(f"WRONG {scenario.name}: {error}", flush=True)
                print("      " + " ".join(sorted(content(root / "case" / "work")))[:2000], flush=True)
    total = {key: sum(found[key] for found in counts.values()) for key in ("kills", "full_disks")}
    print(f"{total['kills']} kills, {total['full_disks']} full disks; {len(wrong)} commands wrong")
    if arguments.json:
        summary = {**total, "seed": arguments.seed, "commands": counts, "wrong": wrong}
        arguments.json.write_text(json.dumps(summary, indent=1) + "\n")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())

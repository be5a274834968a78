"""Run the attack cases, each in a process of its own with limits on time, memory and file size.

``python -m tests.hostile.attack [--every N] [--only TEXT]`` prints what went wrong and a count per group. The
processes are forked from this one, which has loaded everything but Mitsuba's variants: a case takes milliseconds.
What a case may do is watched: it must end by itself with exit code 2 and one line on standard error (or 0 where the
input happens to be sound), change and delete nothing that was there, write below its scratch home only, start no
program and connect to nothing.
"""

from __future__ import annotations

import argparse
import collections
import hashlib
import json
import os
import re
import resource
import shutil
import signal
import stat
import sys
import tempfile
import time
from pathlib import Path

from tests.hostile.cases import Case, all_cases, make_base
from tests.hostile.child import run_command

SECONDS, MEMORY, FILE_SIZE = 20, 3 << 30, 64 << 20
USERS = "here"
"""The working folder of a case, inside its scratch home."""
WATCHED = {
    "os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.symlink", "os.link", "os.truncate", "os.chmod", "os.chown",
    "os.utime", "shutil.rmtree",
}  # fmt: skip
FORBIDDEN = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "socket.connect", "socket.bind"}


def preload() -> None:
    """Import what commands import, so that forked processes need not; threads don't survive a fork, so none start."""
    import cv2
    import h5py  # noqa: F401
    import mitsuba  # noqa: F401
    import OpenEXR  # noqa: F401
    import PIL.Image
    import trimesh  # noqa: F401
    import yaml  # noqa: F401

    import mifit
    import mifit.cli
    import mifit.experiments
    import mifit.output.evaluate
    import mifit.output.export
    import mifit.output.relight
    import mifit.output.report
    import mifit.output.views
    import mifit.synth

    for name in mifit.__all__:
        getattr(mifit, name)
    PIL.Image.init()
    cv2.setNumThreads(1)
    for name in ("builtin:coarse", "builtin"):  # a case's empty home has no copy of what is made in seconds
        mifit.MorphableModel.load(name)


def snapshot(folder: Path) -> dict[str, tuple]:
    """Everything below a folder with what tells a change; links are not followed."""
    found: dict[str, tuple] = {}
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = os.path.join(place, name)
            status = os.lstat(path)
            key: tuple = (stat.S_IFMT(status.st_mode), status.st_ino)
            if stat.S_ISREG(status.st_mode):
                key += (status.st_size, status.st_mtime_ns)
                if status.st_size < 1 << 20:
                    key += (hashlib.sha256(Path(path).read_bytes()).hexdigest(),)
            elif stat.S_ISLNK(status.st_mode):
                key += (os.readlink(path),)
            found[os.path.relpath(path, folder)] = key
    return found


def run_case(case: Case, base: Path, folder: Path) -> tuple[str, str]:
    """Prepare, run and judge one case; returns what it ended with and what is wrong with that ('' for nothing)."""
    work = folder / "home" / USERS
    work.mkdir(parents=True)
    (folder / "home" / "tmp").mkdir()
    for name in case.needs:
        source = base / name
        shutil.copytree(source, work / name, symlinks=True) if source.is_dir() else shutil.copy2(source, work / name)
    case.prepare(work)
    before = snapshot(folder)
    sys.stdout.flush()
    process = os.fork()
    if process == 0:
        _child(case, folder)
    status, seconds = _wait(process)
    if status is None:
        return "hangs", f"still runs after {seconds:.0f} s"
    if os.WIFSIGNALED(status):
        return "killed", f"ended by signal {os.WTERMSIG(status)}"
    code = os.WEXITSTATUS(status)
    problems = []
    error = (folder / "stderr").read_text(errors="replace")
    progress = re.compile(r"[A-Za-z ]+: \d+/\d+, [\d.]+ s$|Model: ")
    lines = [line for line in error.splitlines() if not progress.match(line)]
    if code == 2:
        if len(lines) != 1 or not lines[0].startswith("mifit") or len(lines[0]) > 1500 or "internal error" in error:
            problems.append(f"exit 2 with {len(lines)} lines: {error[-400:]!r}")
    elif code != 0 or not case.may_pass:
        problems.append(f"exit {code}, expected 2: {error[-400:]!r}")
    after = snapshot(folder)
    for name in ("stdout", "stderr", "violations"):
        after.pop(name, None)
    changed = [n for n in before if after.get(n) != before[n]]
    if changed:
        problems.append(f"changed or deleted {changed[:5]}")
    new = [
        n
        for n, key in after.items()
        if n not in before and key[0] != stat.S_IFDIR and not (code == 0 and case.writes(n[len(f"home/{USERS}/") :]))
    ]
    if new:
        problems.append(f"left behind {new[:5]}")
    violations = folder / "violations"
    if violations.exists():
        problems.append(f"did {violations.read_text()[:300]}")
    return str(code), "; ".join(problems)


def _wait(process: int) -> tuple[int | None, float]:
    start = time.monotonic()
    pause = 0.001
    while (taken := time.monotonic() - start) < 6 * SECONDS:  # the processor's time is limited by the system
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return status, taken
        time.sleep(pause)
        pause = min(2 * pause, 0.05)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return None, taken


def _child(case: Case, folder: Path) -> None:
    """Never returns."""

    def prepare() -> None:
        home = folder / "home"
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.chdir(home / USERS)
        for variable in ("MIFIT_CACHE", "XDG_CACHE_HOME", "PYTHONPATH"):
            os.environ.pop(variable, None)
        os.environ |= {"HOME": str(home), "TMPDIR": str(home / "tmp")}
        tempfile.tempdir = None
        now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        for limit, value in (
            (resource.RLIMIT_CPU, SECONDS),
            (resource.RLIMIT_AS, now + MEMORY),
            (resource.RLIMIT_FSIZE, FILE_SIZE),
            (resource.RLIMIT_CORE, 0),
        ):
            resource.setrlimit(limit, (value, value))
        _watch(folder)

    run_command(folder, case.arguments, prepare)


def _watch(folder: Path) -> None:
    """Note every change of a file outside the scratch home, and every program started."""
    home = os.path.realpath(folder / "home") + os.sep
    report = os.open(folder / "violations.part", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.unlink(folder / "violations.part")

    def outside(path: object) -> bool:
        if isinstance(path, int) or path is None:
            return False
        text = os.fsdecode(path) if isinstance(path, (str, bytes, os.PathLike)) else str(path)
        real = os.path.join(os.path.realpath(os.path.dirname(os.path.abspath(text))), os.path.basename(text))
        return not real.startswith(home) and real not in (os.devnull, home[:-1])

    def note(text: str) -> None:
        os.write(report, text.encode(errors="replace"))
        os.link(f"/proc/self/fd/{report}", folder / "violations", follow_symlinks=True)

    busy = False

    def hook(event: str, arguments: tuple) -> None:
        nonlocal busy
        if busy or (event not in WATCHED and event not in FORBIDDEN and event != "open"):
            return
        busy = True
        try:
            if event in FORBIDDEN:
                note(f"{event} {arguments!r}\n")
            elif event == "open":
                path, mode, flags = arguments
                writing = (isinstance(mode, str) and set(mode) & set("wax+")) or (
                    isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
                )
                if writing and outside(path):
                    note(f"opened {path!r} for writing\n")
            elif any(outside(p) for p in arguments[: 2 if event in ("os.rename", "os.link", "os.symlink") else 1]):
                note(f"{event} {arguments!r}\n")
        except FileExistsError:  # noted already
            pass
        finally:
            busy = False

    sys.addaudithook(hook)


def main() -> int:
    """Command line; exit code 1 when a case went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--every", type=int, default=1, help="run each N-th case of every group")
    parser.add_argument("--only", default="", help="run the cases whose names hold this text")
    parser.add_argument("--json", type=Path, help="write the counts to a file")
    arguments = parser.parse_args()
    preload()
    counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    wrong = []
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="attack-") as name:
        root = Path(name)
        base = make_base(root / "base")
        cases = [case for case in all_cases(base) if arguments.only in case.name]
        number: collections.Counter[str] = collections.Counter()
        for i, case in enumerate(cases):
            number[case.group] += 1
            if (number[case.group] - 1) % arguments.every:
                continue
            folder = root / f"{i:04d}"
            ended, problem = run_case(case, base, folder)
            counts[case.group][ended] += 1
            if problem:
                wrong.append((case.name, problem))
                print(f"WRONG {case.name} {' '.join(case.arguments)}\n      {problem}", flush=True)
            shutil.rmtree(folder)
    total: collections.Counter[str] = sum(counts.values(), collections.Counter())
    for group, found in [*counts.items(), ("all", total)]:
        rest = {k: v for k, v in found.items() if k not in "02"}
        print(f"{group:<28}{sum(found.values()):>5} cases{found['2']:>6} refused{found['0']:>5} sound  {rest or ''}")
    print(f"{len(wrong)} wrong, {time.monotonic() - start:.0f} s")
    if arguments.json:
        summary = {"cases": sum(total.values()), "refused": total["2"], "sound": total["0"], "wrong": dict(wrong)}
        arguments.json.write_text(json.dumps(summary, indent=1) + "\n")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())

"""The ``mifit`` command: parsing, exit codes and nothing else; the work is in ``mifit.commands``.

Exit codes: 0 success, 2 bad usage or bad input (one line on stderr), 1 a failure of mifit's own, 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import mifit
from mifit.commands import arguments
from mifit.console import drop_chatter
from mifit.core.allocator import keep_freed_memory
from mifit.core.files import FULL
from mifit.core.limits import MAX_RENDERED_PIXELS, MAX_SAMPLES, MAX_SEED
from mifit.errors import InputError, MifitError

LONGEST = 1000
"""Characters of a message; one that quotes more of an input says nothing."""


class _Parser(argparse.ArgumentParser):
    """Reports bad usage in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {_one_line(message)}; see {self.prog} --help\n")


def _one_line(text: str) -> str:
    """A message as one line of a terminal: no control characters, and not without end."""
    line = " ".join(text.split())
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    common: Any = argparse.ArgumentParser(add_help=False)
    common.add_argument("--quiet", action="store_true", help="no progress on stderr")
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    common.add_argument(
        "--variant",
        default="auto",
        help="Mitsuba variant; auto: CUDA where it works, else LLVM (default: auto)",
    )
    common.add_argument("--threads", type=arguments.whole(1, 1024), help="processor cores to use; default: all")
    common.add_argument(
        "--seed", type=arguments.whole(0, MAX_SEED), default=0, help="seed of everything random (default: 0)"
    )

    parser = _Parser(prog="mifit", description="Facial reflectance and geometry from two views.")
    parser.add_argument("--version", action="version", version=f"mifit {mifit.__version__}")
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", parser_class=_Parser, title="commands"
    )

    def add(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".", parents=[common])

    def add_rate(p: argparse.ArgumentParser) -> None:
        p.add_argument(
            "--fps", type=arguments.rate, default=12.0, help="timesteps per second of what moves (default: 12)"
        )

    def add_address(p: argparse.ArgumentParser) -> None:
        p.add_argument("--host", default="127.0.0.1", help="of the view: address (default: this machine only)")
        p.add_argument(
            "--port", type=arguments.whole(0, 65535), default=8080, help="of the view (default: 8080); 0: a free one"
        )

    p = add("doctor", "what of the set-up works, what doesn't, and the command that mends it")
    p.add_argument("--json", action="store_true", help="print JSON")
    p.add_argument("--install", choices=["landmarks"], help="fetch the networks that find landmarks, then check")

    p = add("demo", "fit a small capture made on the spot, judge it on the held-out view, write a report")
    p.add_argument("--out", type=arguments.path, default=Path("out/demo"), help="folder to write (default: out/demo)")

    p = add("synth", "path-traced captures with ground truth")
    p.add_argument("--out", type=arguments.path, required=True, help="capture folder to write")
    p.add_argument("--subjects", type=arguments.at_least(1), default=1, help="people, a capture each (default: 1)")
    p.add_argument("--timesteps", type=arguments.at_least(1), default=4, help="moments of a capture (default: 4)")
    p.add_argument("--env", type=arguments.path, help="lat-long HDR environment; default: a procedural studio")
    p.add_argument("--model", default="builtin", help="morphable model: a path or builtin")
    p.add_argument(
        "--width", type=arguments.whole(16, MAX_RENDERED_PIXELS // 16), default=680, help="pixels (default: 680)"
    )
    p.add_argument(
        "--height", type=arguments.whole(16, MAX_RENDERED_PIXELS // 16), default=480, help="pixels (default: 480)"
    )
    p.add_argument("--spp", type=arguments.whole(1, MAX_SAMPLES), default=64, help="samples per pixel (default: 64)")
    p.add_argument("--tone", type=arguments.real, help="skin from 0, fair, to 1, deep; default: drawn for each subject")
    p.add_argument(
        "--motion",
        choices=["poses", "talk", "turn"],
        default="poses",
        help="default: poses; of talk and turn 30 timesteps are a second",
    )
    p.add_argument(
        "--outside",
        type=arguments.real,
        default=0.5,
        help="millimetres by which heads leave the model's span (default: 0.5)",
    )
    p.add_argument(
        "--landmark-bias", type=arguments.real, default=0.0, help="millimetres; a detector's is about 2 (default: 0)"
    )
    p.add_argument(
        "--head", type=arguments.path, help="a scanned head with texture coordinates (.glb, .obj, .ply), moved rigidly"
    )
    p.add_argument(
        "--maps",
        nargs="+",
        default=[],
        metavar="NAME=FILE",
        help="of --head: albedo, specular, roughness, displacement",
    )
    p.add_argument(
        "--unit-mm", type=arguments.real, default=10.0, help="of --head: millimetres of its unit (default: 10)"
    )
    p.add_argument("--flip-v", action="store_true", help="of --head: turn its maps upside down")
    p.add_argument(
        "--relit", type=arguments.path, nargs="+", default=[], help="of --head: environments of relit true views"
    )
    p.add_argument("--force", action="store_true", help="write into a folder that holds something already")

    p = add("import", "a capture from videos, image folders, photogrammetry projects, nerfstudio, VHAP or NeRSemble")
    p.add_argument(
        "--video", type=arguments.path, action="append", default=[], help="one camera's video; repeat per camera"
    )
    p.add_argument(
        "--images", type=arguments.path, action="append", default=[], help="one camera's folder of images; repeat"
    )
    p.add_argument("--calibration", type=arguments.path, help="OpenCV stereo calibration, YAML or XML")
    p.add_argument("--colmap", type=arguments.path, help="folder of a COLMAP model, text or binary")
    p.add_argument("--metashape", type=arguments.path, help="cameras exported by Metashape as XML")
    p.add_argument(
        "--realitycapture", type=arguments.path, help="folder of RealityCapture's XMP files, or its CSV of cameras"
    )
    p.add_argument(
        "--photos", type=arguments.path, help="folder of the photographs of these three (default: beside them)"
    )
    p.add_argument("--vhap", type=arguments.path, help="folder exported by VHAP")
    p.add_argument("--nersemble", type=arguments.path, help="folder of one sequence of NeRSemble")
    p.add_argument("--transforms", type=arguments.path, help="nerfstudio transforms.json")
    p.add_argument("--digital-emily", type=arguments.path, help="checkout of the public Digital Emily repository")
    p.add_argument(
        "--units", help="unit of length of the cameras: mm, cm, dm or m (default: as the source has it, or cm)"
    )
    p.add_argument("--every", type=arguments.at_least(1), default=1, help="keep every N-th frame (default: 1)")
    p.add_argument("--start", type=arguments.at_least(0), default=0, help="first frame (default: 0)")
    p.add_argument("--count", type=arguments.at_least(1), help="number of frames to keep")
    p.add_argument("--out", type=arguments.path, required=True, help="capture folder to write")

    p = add("calibrate", "cameras from a calibration board, or of an uncalibrated capture from the heads in it")
    p.add_argument(
        "capture", type=arguments.path, nargs="?", help="uncalibrated capture; the cameras are written into it"
    )
    p.add_argument(
        "--video", type=arguments.path, action="append", default=[], help="one camera's video of the board; repeat"
    )
    p.add_argument(
        "--images", type=arguments.path, action="append", default=[], help="one camera's folder of images; repeat"
    )
    p.add_argument(
        "--board",
        help="charuco:9x6:30:22, chessboard:10x7:25 or apriltag:6x4:34:9: columns, rows and lengths in millimetres; "
        "without videos and images it is written for printing",
    )
    p.add_argument("--units", default="cm", help="unit of length of the calibration: mm, cm or m (default: cm)")
    p.add_argument("--model", default="builtin", help="of a capture: morphable model, a path or builtin (default)")
    p.add_argument("--cameras", type=arguments.listed, help="of a capture: cameras that decide; default: the first two")
    p.add_argument(
        "--timesteps", type=arguments.timesteps, help="of a capture: timesteps to use; default: the first four"
    )
    p.add_argument("--out", type=arguments.path, help="of a board: folder to write")

    p = add("landmarks", "detect 68 landmarks in every image and write them into the capture")
    p.add_argument("capture", type=arguments.path, help="capture folder, or its transforms.json")
    p.add_argument("--detector", help="mediapipe, face-alignment or lbf:FOLDER; default: the first that is there")

    p = add("fit", "fit geometry, reflectance and normals to a capture")
    p.add_argument("capture", type=arguments.path, help="capture folder, or its transforms.json")
    p.add_argument("--out", type=arguments.path, required=True, help="result folder to write")
    p.add_argument(
        "--config", type=arguments.path, help="TOML file with tables geometry, reflectance, shape, normals, mesh"
    )
    p.add_argument("--preset", choices=["default", "paper"], help="paper: the paper as written")
    p.add_argument("--model", default="builtin", help="morphable model: a path or builtin (default)")
    p.add_argument("--cameras", type=arguments.listed, help="cameras to use, e.g. left,right; default: the first two")
    p.add_argument(
        "--timesteps",
        type=arguments.timesteps_or_auto,
        help="e.g. 0,1,2,3 or 0-3, or auto (auto:6): the four (six) that tell most; default: the first four",
    )
    p.add_argument(
        "--until",
        choices=["geometry", "reflectance", "normals"],
        default="normals",
        help="last stage (default: normals, everything)",
    )
    p.add_argument("--resume", action="store_true", help="go on with a run that was stopped")
    p.add_argument("--force", action="store_true", help="replace an existing result")
    p.add_argument(
        "--view", action="store_true", help="show the fit in the browser while it is being fitted, and after"
    )
    add_address(p)

    p = add("track", "geometry and normals of further timesteps, reflectance and lighting fixed")
    p.add_argument("capture", type=arguments.path, help="capture folder, or its transforms.json")
    p.add_argument("--result", type=arguments.path, required=True, help="result folder of mifit fit; extended in place")
    p.add_argument("--timesteps", type=arguments.timesteps, help="default: all that aren't in the result yet")
    p.add_argument("--resume", action="store_true", help="keep the frames that an earlier run has written")
    p.add_argument(
        "--refine", action="store_true", help="also add what the frames show to the maps and normals of the result"
    )
    p.add_argument(
        "--overlay", type=arguments.listed, help="cameras to write overlay videos of; default: the fitted ones"
    )
    add_rate(p)

    p = add("evaluate", "error on a held-out view")
    p.add_argument("result", type=arguments.path, help="result folder of mifit fit")
    p.add_argument("--capture", type=arguments.path, required=True, help="capture that has the view")
    p.add_argument("--camera", required=True, help="camera to judge by, one that was not fitted")
    p.add_argument(
        "--timesteps",
        type=arguments.timesteps,
        help="default: all of the result; at one without a fit landmarks place the head",
    )
    p.add_argument(
        "--region", choices=["model", "truth"], default="model", help="whose face area counts (default: model)"
    )
    p.add_argument("--baseline", action="store_true", help="compare image-based rendering on the same mesh and pixels")
    p.add_argument("--json", type=arguments.path, help="file to write the figures to")

    p = add("render", "render a reconstruction from a camera of the capture, or from any side")
    p.add_argument("result", type=arguments.path, help="result folder of mifit fit")
    p.add_argument("--capture", type=arguments.path, help="capture that --camera is of; default: the fitted cameras")
    p.add_argument("--camera", help="default: a view of the face from --yaw, --pitch and --distance")
    p.add_argument("--yaw", type=arguments.real, help="degrees about the vertical; 0 is the front")
    p.add_argument("--pitch", type=arguments.real, help="degrees upwards")
    p.add_argument(
        "--distance", type=arguments.rate, help="from the face, the result's units; default: the fitted cameras'"
    )
    p.add_argument("--timestep", type=arguments.at_least(0), help="default: the first of the result")
    p.add_argument(
        "--out", type=arguments.path, required=True, help="image to write: .png (8-bit sRGB) or .exr (linear)"
    )
    p.add_argument(
        "--method",
        choices=["full", "diffuse", "pca"],
        default="full",
        help="everything (default), without specular, the model alone",
    )
    p.add_argument(
        "--integrator", choices=["local", "path"], default="local", help="closed form (default) or path tracing"
    )

    p = add("turntable", "novel views about the vertical axis, with and without specular")
    p.add_argument("result", type=arguments.path, help="result folder of mifit fit")
    p.add_argument("--out", type=arguments.path, required=True, help="folder to write")
    p.add_argument(
        "--from", dest="start", type=arguments.real, default=-35.0, help="first angle in degrees (default: -35)"
    )
    p.add_argument("--to", dest="stop", type=arguments.real, default=35.0, help="last angle in degrees (default: 35)")
    p.add_argument("--steps", type=arguments.at_least(1), default=7, help="number of views (default: 7)")
    p.add_argument(
        "--sequence",
        action="store_true",
        help="play the timesteps while the camera turns: sequence.mp4, one frame per timestep in place of --steps",
    )
    add_rate(p)

    p = add("view", "a live view in the browser: turn the head and the light, switch parts, load an environment")
    p.add_argument("result", type=arguments.path, help="result folder")
    add_address(p)

    p = add("relight", "relit views under a measured environment")
    p.add_argument("result", type=arguments.path, help="result folder of mifit fit")
    p.add_argument("--env", type=arguments.path, required=True, help="lat-long environment, .hdr or .exr")
    p.add_argument("--out", type=arguments.path, required=True, help="folder to write")
    p.add_argument(
        "--rotate",
        type=arguments.real,
        default=0.0,
        help="turn the environment about the vertical, degrees (default: 0)",
    )
    p.add_argument("--sequence", action="store_true", help="also play the timesteps from the front: sequence.mp4")
    add_rate(p)

    p = add("export", "geometry with its maps for other programs")
    p.add_argument("result", type=arguments.path, help="result folder of mifit fit")
    p.add_argument("--format", choices=["glb", "obj", "ply", "mitsuba"], required=True, help="kind of file")
    p.add_argument("--out", type=arguments.path, required=True, help="file to write")
    p.add_argument("--timestep", type=arguments.at_least(0), help="default: the first of the result")
    p.add_argument("--animate", action="store_true", help="glb: play all timesteps, from --timestep's maps")
    add_rate(p)
    p.add_argument(
        "--mesh",
        choices=["fitted", "refined"],
        default="fitted",
        help="refined: with the refined normals as shape, and its displacement map (default: fitted)",
    )

    p = add("run", "a scene-file driven experiment or a sweep of them")
    p.add_argument("experiment", type=arguments.path, help="experiment file, TOML")
    p.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help="replace a setting; repeat"
    )
    p.add_argument("--out", type=arguments.path, help="folder of the runs; default: out/NAME")
    p.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster to run on")

    p = add("model", "inspect and convert morphable models")
    actions = p.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=_Parser)
    q = actions.add_parser("info", help="print a table", parents=[common])
    q.add_argument("model", help="a path or builtin")
    q.add_argument("--preview", type=arguments.path, help="also write a sheet of the mean and the first modes")
    q = actions.add_parser("convert", help="write a model in mifit's own format", parents=[common])
    q.add_argument("source", type=arguments.path, help="file of a model, of any known kind")
    q.add_argument("out", type=arguments.path, help="file to write, .npz")
    q.add_argument("--kind", help="format of SOURCE; default: recognised by content")
    q.add_argument("--eyes", action="store_true", help="put simple eyes and a mouth's inside where the model has holes")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    Without ``argv`` this is the program itself, which owns its process: what C libraries print is dropped.
    """
    parser = build_parser()
    for word in sys.argv[1:] if argv is None else argv:
        if word.startswith("--") and word.endswith("=--"):  # argparse would make an empty list of it
            parser.error(f"argument {word[:-3]}: found '--', expected a value")
    arguments = parser.parse_args(argv)
    if argv is None:
        keep_freed_memory()
        if not arguments.debug:
            drop_chatter()
    try:
        if arguments.threads:
            from mifit.core.threads import set_threads

            set_threads(arguments.threads)
        from mifit import commands

        code = _run(getattr(commands, arguments.command.replace("import", "import_")), arguments)
        sys.stdout.flush()  # a full disk behind a redirection is met here
        return code
    except KeyboardInterrupt:
        print("mifit: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone; nothing is left to say
        _give_up_unwritten()
        return 1
    except Exception as error:
        if arguments.debug:
            raise
        _give_up_unwritten()
        return _report(error)


def _give_up_unwritten() -> None:
    """Drop output that can't be written: the interpreter would try again at its end, and fail in words of its own."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(command: Callable[[Any], int | None], arguments: argparse.Namespace) -> int:
    return command(arguments) or 0


def _report(error: Exception) -> int:
    """One line on stderr and the exit code that goes with the error."""
    message = _one_line(str(error))
    if isinstance(error, MifitError):
        print(f"mifit: {message}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    if isinstance(error, OSError) and (error.filename or error.errno in FULL):
        place = error.filename or "an output file"
        print(_one_line(f"mifit: {place}: {error.strerror}; what was there is unchanged"), file=sys.stderr)
        return 2
    if isinstance(error, MemoryError):
        print("mifit: not enough memory; use fewer timesteps, smaller images or smaller maps", file=sys.stderr)
        return 1
    print(f"mifit: internal error, {type(error).__name__}: {message}; run again with --debug", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())

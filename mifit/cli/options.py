"""The commands of ``mifit``, their options, and the parser made of them."""

from __future__ import annotations

import argparse
import importlib
import re
from argparse import Namespace
from functools import partial

import mifit
from mifit.cli.arguments import READERS, Parser, whole
from mifit.core.files import Document
from mifit.core.limits import MAX_COUNT, MAX_SEED

COMMON = f"""
--quiet    flag       no progress on stderr, warnings alone
--debug    flag       show the traceback of an error
--variant  text=auto  Mitsuba variant; auto: CUDA where it works, else LLVM (default: auto)
--threads  1..1024    processor cores to use; default: all
--seed     0..{MAX_SEED}=0  seed of everything random (default: 0)
"""
FORCE = "--force  flag  replace files that are there, but never what is read"
STRICT = "--strict  flag  exit with 3 where a fault of the capture is named"
FPS = "--fps  rate=12.0  timesteps per second of what moves (default: 12)"
OFFSET = """
--offset  offsets<S,S>  of clips: seconds by which each began after the first, such as 0,0.4; or auto, found by sound
    or motion (of mifit fit the default)"""
TRIM = "--trim  span<B:E>  of clips: seconds of the first one from which, and up to which, frames are taken"
ADDRESS = """
--host  text=127.0.0.1    of the view: address (default: this machine only)
--port  0..65535=8080  of the view (default: 8080); 0: a free one"""
LIGHT = """
--env{need}  path  lat-long environment, .hdr or .exr
--rotate    real=0.0      of --env: degrees about the vertical (default: 0)
--exposure  exposure=1.0  of --env: factor on the file's radiance (default: 1), or auto: the capture's level"""

# Command, the function that runs it, what it does; then a line for each argument: name, kind with its default, help.
# After a name: ! required, ? optional, + one or more, * repeated, >x kept as x. Kinds are flag, a|b|c, low..high, and
# those of `arguments.READERS`; <X> stands for the value in the help.
COMMANDS = f"""
doctor  setup.doctor  what of the set-up, or of a capture, is wrong, and what mends it
    capture?     path       capture to examine; default: the set-up
    --model      text=auto  of a capture: a path, builtin or auto (default)
    --cameras    names      of a capture: cameras to examine; default: the first two
    --timesteps  steps      of a capture: default: the first four
    --dense      flag       of a capture: fit it, compare the views on its surface and test the calibration by it
    {STRICT}
    --json       flag       print JSON
    --install    landmarks  fetch the networks that find landmarks, then check

model info  setup.model  print a table
    model      text  a path, builtin or auto
    {FORCE}

model convert  setup.model  write a model in mifit's own format
    source  path  file of a model, of any known kind
    out     path  file to write, .npz
    {FORCE}
    --kind  text  format of SOURCE; default: recognised by content
    --eyes  flag  put simple eyes and a mouth's inside where the model has holes

model fetch  setup.model  fetch a public model, once, for --model auto
    name            ict   ict: ICT-FaceKit Light (MIT licence), 400 MB to fetch, 30 to keep
    --from>address  text  address of its folder FaceXModel; default: its public repository
    {FORCE}

synth  captures.synth  path-traced captures with ground truth
    --out!           path             capture folder to write
    --subjects       1..=1      people, a capture each (default: 1)
    --timesteps      1..=4      moments of a capture (default: 4)
    --env            path             lat-long HDR environment; default: a procedural studio
    --model          text=builtin     morphable model: a path or builtin
    --width          16..=680         pixels (default: 680)
    --height         16..=480         pixels (default: 480)
    --spp            1..=64           samples per pixel (default: 64)
    --tone           real             skin from 0, fair, to 1, deep; default: drawn for each subject
    --portrait       flag             people with few marks on their skin, which shines less
    --outside        real=0.5         millimetres by which heads leave the model's span (default: 0.5)
    --landmark-bias  real=0.0         millimetres; a detector's is about 2 (default: 0)
    --head           path             a scanned head with texture coordinates (.glb, .obj, .ply), moved rigidly
    --maps+          text<NAME=FILE>  of --head: albedo, specular, roughness, displacement
    --unit-mm        real=10.0        of --head: millimetres of its unit (default: 10)
    --flip-v         flag             of --head: turn its maps upside down
    --relit+         path             of --head: environments of relit true views
    --force          flag             write into a folder that holds something already

import  captures.import_  a capture from videos, image folders, COLMAP text models or nerfstudio
    --video*          path  one camera's video; repeat per camera
    --images*         path  one camera's folder of images; repeat
    --calibration     path  OpenCV stereo calibration, YAML
    --colmap          path  folder of a COLMAP text model
    --photos          path  of --colmap: folder of the photographs (default: beside the model)
    --transforms      path  nerfstudio transforms.json
    --units           text  unit of length of the cameras: mm, cm, dm or m (default: as the source has it, or cm)
    {OFFSET}
    {TRIM}
    --every           1..=1  keep every N-th frame (default: 1)
    --start           0..=0  first frame (default: 0)
    --count           1..    number of frames to keep
    --out!            path         capture folder to write

calibrate  captures.calibrate  cameras from a calibration board, or of a capture from the heads in it
    capture?     path       the cameras are written into it
    --video*     path       one camera's video of the board; repeat
    --images*    path       one camera's folder of images; repeat
    {OFFSET}
    --board      text       charuco:9x6:30:22: columns, rows and lengths in millimetres;
        without videos and images it is written for printing
    --names      names      of a board: names of the cameras; default: those of the files
    --units      text=cm    unit of length of the calibration: mm, cm or m (default: cm)
    --model      text=auto  of a capture: a path, builtin or auto (default)
    --cameras    names      of a capture: cameras that decide; default: the first two
    --timesteps  steps      of a capture: timesteps to use; default: the first four
    --out        path       of a board: folder to write
    --force      flag       of a board: write into a folder that holds something already

landmarks  captures.landmarks  detect 68 landmarks in every image and write them into the capture
    capture     path  capture folder, or its transforms.json
    --detector  text  mediapipe or face-alignment; default: face-alignment where it is installed

demo  fits.demo  fit a small capture made on the spot, judge it on the held-out view, write a report
    --out  path=out/demo  folder to write (default: out/demo)

fit  fits.fit  fit geometry, reflectance and normals to a capture, or to clips of a face
    capture+       path  capture folder; or a clip, folder of frames or photograph of each camera, of which a capture
        is made in the result's folder: frames brought into step and chosen, landmarks found, cameras estimated
    --out!         path        result folder to write
    --calibration  path        of clips: stereo calibration or transforms.json
    --board+       path        of clips: a clip of a calibration board by each camera
    --pattern      text=charuco:9x6:30:22  of --board: as mifit calibrate --board takes it
    {OFFSET}
    {TRIM}
    --every        1..   of clips: keep every N-th frame; default: 24 in all
    --config       path        TOML file with tables geometry, surface, photometry, reflectance, normals, mesh, residual
    --preset       default|paper  paper: the paper as written
    --model        text=auto   morphable model: a path, builtin, or auto (default): the one that mifit model fetch has
        fetched, else builtin
    --cameras      names       cameras to use, e.g. left,right; default: the first two
    --timesteps    auto_steps  e.g. 0,1,2,3 or 0-3, or auto (auto:6): the four (six) best ones; default: the first
        four, of clips auto
    --until        geometry|reflectance|normals=normals  last stage (default: normals, everything)
    --resume       flag        go on with a run that was stopped
    --force        flag        replace an existing result
    {STRICT}

track  fits.track  geometry and normals of further timesteps, reflectance and lighting fixed
    capture      path   capture folder, or its transforms.json
    --result!    path   result folder of mifit fit; extended in place
    --timesteps  steps  default: all that aren't in the result yet
    --resume     flag   keep the frames that an earlier run has written
    --refine     flag   first find maps, lighting and normals anew, from frames of the video too
    --overlay    names  cameras to write overlay videos of; default: the fitted ones
    {STRICT}
    {FPS}

run  fits.run  a scene-file driven experiment or a sweep of them
    experiment         path             experiment file, TOML
    --set>overrides*   text<KEY=VALUE>  replace a setting; repeat
    --out              path             folder of the runs; default: out/NAME
    --dask             text<ADDRESS>    scheduler of a Dask cluster to run on

evaluate  results.evaluate  error on a held-out view
    result       path   result folder of mifit fit
    --capture!   path   capture that has the view
    --camera!    text   camera to judge by, one that was not fitted
    --timesteps  steps  of the result; default: all
    --region     face|skin|truth=face  the fitted model's face area (default); skin, as the benchmarks have it; the
        truth's face area
    --fitted     flag   of a camera that was fitted: its error is no held-out one
    --baseline   flag   compare image-based rendering on the same mesh and pixels
    --passes     flag   compare diffuse and specular images of the capture's first timestep with the truth's
    --json       path   file to write the figures to
    {FORCE}
    {STRICT}

score  results.score  any program's images, relit views, passes or meshes against a capture's truth
    capture    path   capture folder with truth, or its transforms.json
    --images!  path   folder with CAMERA_TTTT.png, relit_ENV.exr, diffuse_CAMERA.exr, specular_CAMERA.exr, TTTT.ply
    --cameras  names  cameras that the program was given; default: the first two
    --model    text   morphable model that the capture was made with, if its truth has no triangles
    --json     path   file to write the scores to
    {FORCE}

render  results.render  render a reconstruction from a camera of the capture, or from any side
    result        path        result folder of mifit fit
    --capture     path        capture that --camera is of; default: the fitted cameras
    --camera      text        default: a view of the face from --yaw, --pitch and --distance
    --yaw         real        degrees about the vertical; 0 is the front
    --pitch       real        degrees upwards
    --distance    positive    from the face, the result's units; default: the fitted cameras'
    --timestep    0..   default: the first of the result
    --out!        path        image to write: .png (8-bit sRGB) or .exr (linear)
    {FORCE}
    --method      full|diffuse|pca=full  everything (default), without specular, the model alone
    --integrator  local|path=local       closed form (default) or path tracing

turntable  results.turntable  novel views about the vertical axis, with and without specular
    result        path         result folder of mifit fit
    --out!        path         folder to write
    {FORCE}
    --from>start  real=-35.0   first angle in degrees (default: -35)
    --to>stop     real=35.0    last angle in degrees (default: 35)
    --steps       1..=7  number of views (default: 7)
    {LIGHT.format(need="")}

view  results.view  a live view in the browser: turn the head and the light, switch parts, load an environment
    result  path  result folder
    {ADDRESS}

relight  results.relight  relit views under a measured environment
    result        path         result folder of mifit fit
    --out!        path         folder to write
    {FORCE}
    {LIGHT.format(need="!")}
    --turn        1..    number of rotations of the light about the vertical
    --video       path         of --turn: .mp4 or .webp to write in place of images
    --camera      text         a fitted camera; default: all of them, with --turn the front
    --yaw         real         a view of the face from so many degrees about the vertical
    --size        16..         width in pixels
    --integrator  local|path=local  fast (default) or path tracing
    --check       flag         compare both integrators in one small view
    {FPS}

export  results.export  geometry with its maps for other programs
    result      path       result folder of mifit fit
    --format!   glb|obj|ply|usd|mitsuba  kind of file
    --out!      path       file to write
    {FORCE}
    --timestep  0..  default: the first of the result
    --units     m|cm|mm    of obj and ply; default: the result's
    --animate   flag       glb: play all timesteps, from --timestep's maps
    {FPS}
    --mesh      fitted|refined=fitted  refined: with the refined normals as shape (default: fitted)
"""
EXAMPLES = """examples:
  mifit demo                                               a face from a capture made on the spot
  mifit fit left.mp4 right.mp4 --out me                    a face from two clips of it
  mifit relight me --env studio.hdr --out relit --turn 36  that face under a turning light"""
_ARGUMENT = re.compile(r"\s*(?P<name>[\w-]+)(?:>(?P<dest>\w+))?(?P<mark>[!?+*]?)  +(?P<kind>\S+)  +(?P<help>.+)")
_KIND = re.compile(r"(?P<kind>.+?)(?:=(?P<default>.*))?(?:<(?P<metavar>.+)>)?")


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; ``run`` of what it parses is the command."""
    parser = Parser(
        prog="mifit",
        description="Facial reflectance and geometry from two views.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"mifit {mifit.__version__}")
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", parser_class=Parser, title="commands"
    )
    common = Parser(add_help=False)
    _add(common, COMMON)
    actions: argparse._SubParsersAction[Parser] | None = None
    for paragraph in COMMANDS.strip().split("\n\n"):
        head, _, lines = paragraph.partition("\n")
        name, function, text = re.split("  +", head, maxsplit=2)
        group, _, action = name.partition(" ")
        if action and actions is None:
            text_of_group = "inspect, convert and fetch morphable models"
            p = _command(commands, group, text_of_group, common)
            actions = p.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
        p = _command(actions, action, text, common) if action and actions else _command(commands, name, text, common)
        p.set_defaults(run=partial(_run, *function.split(".")))
        _add(p, lines)
    return parser


def _run(module: str, name: str, arguments: Namespace) -> int | None:
    """Run a command, whose module is loaded now."""
    return getattr(importlib.import_module(f"mifit.cli.{module}"), name)(arguments)


def _command(
    commands: argparse._SubParsersAction[Parser], name: str, text: str, common: Parser
) -> argparse.ArgumentParser:
    return commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".", parents=[common])


def _add(parser: argparse.ArgumentParser, lines: str) -> None:
    """Add the arguments of a table; a line without its columns goes on with the help of the one before."""
    rows: list[dict[str, str]] = []
    for line in filter(str.strip, lines.split("\n")):
        found = _ARGUMENT.fullmatch(line)
        if found:
            rows.append(found.groupdict())
        else:
            assert not line.strip().startswith("--"), line
            rows[-1]["help"] += " " + line.strip()
    for row in rows:
        kind = _KIND.fullmatch(row["kind"])
        assert kind is not None
        options: Document = {"help": row["help"]} | _reader(kind["kind"])
        options |= {key: kind[key] for key in ("default", "metavar") if kind[key]}
        if row["name"].startswith("--"):
            options |= {"dest": row["dest"]} if row["dest"] else {}
            options |= {"required": True} if row["mark"] == "!" else {}
            options |= {"action": "append", "default": []} if row["mark"] == "*" else {}
        options |= {"nargs": row["mark"]} if row["mark"] in ("?", "+") else {}
        parser.add_argument(row["name"], **options)


def _reader(kind: str) -> Document:
    """Keywords for argparse of a kind of argument."""
    if kind == "flag":
        return {"action": "store_true"}
    if kind in READERS:
        return {"type": READERS[kind]}
    low, dots, high = kind.partition("..")
    if dots:
        return {"type": whole(int(low), int(high or MAX_COUNT))}
    return {"choices": kind.split("|")}

"""Commands that look at the machine and at models. Arguments are parsed; bad input raises InputError."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import Any

from mifit.cli import arguments as types
from mifit.cli.console import console_progress


def doctor(arguments: Namespace) -> int:
    """Print what works; exit code 1 when the pipeline can't run."""
    from mifit.capture.face_networks import install_networks, missing, networks_folder
    from mifit.render.variant import doctor

    if arguments.install == "landmarks":
        install_networks()
    problem = missing()
    found = "not ready" if problem else str(networks_folder())
    checks = [*doctor(), {"check": "landmarks", "ok": not problem, "required": False, "found": found, "fix": problem}]
    if arguments.json:
        print(json.dumps(checks, indent=2))
    else:
        width = max(len(check["check"]) for check in checks)
        for check in checks:
            mark = "ok  " if check["ok"] else ("FAIL" if check["required"] else "-   ")
            print(f"{mark} {check['check']:<{width}}  {check['found']}")
            if not check["ok"] and check["fix"]:
                print(f"     {'':<{width}}  mend: {check['fix']}")
    return 0 if all(check["ok"] for check in checks if check["required"]) else 1


@types.writes("preview", "out")
def model(arguments: Namespace) -> None:
    """Inspect, convert or fetch a morphable model."""
    import mifit
    from mifit.extras.fetch_model import ADDRESS, fetch_ict
    from mifit.morphable import describe
    from mifit.morphable.openings import with_eyes

    if arguments.action == "fetch":
        path = fetch_ict(arguments.address or ADDRESS, console_progress(arguments.quiet))
        print(f"Model: {path}; --model auto, the default, takes it from now on")
    elif arguments.action == "info":
        loaded = mifit.MorphableModel.load(arguments.model)
        print(describe.model_info(loaded))
        if arguments.preview:
            describe.save_preview(loaded, arguments.preview)
            print(f"Preview: {arguments.preview}")
    else:
        options: dict[str, Any] = {"kind": arguments.kind} if arguments.kind else {}
        loaded = mifit.MorphableModel.load(arguments.source, **options)
        (with_eyes(loaded) if arguments.eyes else loaded).save(arguments.out)
        print(f"Model: {arguments.out}")


def add_commands(add: types.Add) -> None:
    """Add these commands to the parser."""
    p = add("doctor", doctor, "what of the set-up works, what doesn't, and the command that mends it")
    p.add_argument("--json", action="store_true", help="print JSON")
    p.add_argument("--install", choices=["landmarks"], help="fetch the networks that find landmarks, then check")

    p = add("model", model, "inspect, convert and fetch morphable models")
    actions = p.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=types.Parser)
    common = types.common_options()
    q = actions.add_parser("info", help="print a table", parents=[common])
    q.add_argument("model", help="a path, builtin or auto")
    q.add_argument("--preview", type=types.path, help="also write a sheet of the mean and the first modes")
    types.add_force(q)
    q = actions.add_parser("convert", help="write a model in mifit's own format", parents=[common])
    q.add_argument("source", type=types.path, help="file of a model, of any known kind")
    q.add_argument("out", type=types.path, help="file to write, .npz")
    types.add_force(q)
    q.add_argument("--kind", help="format of SOURCE; default: recognised by content")
    q.add_argument("--eyes", action="store_true", help="put simple eyes and a mouth's inside where the model has holes")
    q = actions.add_parser("fetch", help="fetch a public model, once, for --model auto", parents=[common])
    q.add_argument("name", choices=["ict"], help="ict: ICT-FaceKit Light (MIT licence), 400 MB to fetch, 30 to keep")
    q.add_argument("--from", dest="address", help="address of its folder FaceXModel; default: its public repository")
    types.add_force(q)

"""Commands that look at the machine and at models. Arguments are parsed; bad input raises InputError."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    pass


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


def model(arguments: Namespace) -> None:
    """Inspect or convert a morphable model."""
    import mifit
    from mifit.morphable import describe
    from mifit.morphable.openings import with_eyes

    if arguments.action == "info":
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

"""`Diagnostic`: one thing that a person should know of a capture or of a fit, with a code for programs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

Severity = Literal["fault", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("fault", "warning", "note")
"""The worst first."""


@dataclass(frozen=True)
class Diagnostic:
    """One finding.

    Attributes
    ----------
    code : str
        What it is, for programs: words with hyphens, e.g. ``"camera-mirrored"``.
    text : str
        One sentence or two: the figure found, what was expected, the remedy.
    severity : {"fault", "warning", "note"}
        ``"fault"``: the capture is wrong, and this names how; ``"warning"``: the result may be wrong; ``"note"``: a
        choice of the fit that a person may want to know of.
    camera : str or None
        The camera that it concerns; None where it isn't one camera's.
    """

    code: str
    text: str
    severity: Severity = "warning"
    camera: str | None = None

    def __str__(self) -> str:
        return self.text

    def document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)

    @classmethod
    def of(cls, document: dict[str, Any]) -> Diagnostic:
        """From `document`; ValueError for another severity, KeyError for a missing key."""
        code, text, severity, camera = (document[key] for key in ("code", "text", "severity", "camera"))
        if severity not in SEVERITIES:
            raise ValueError(f"severity: found {severity!r}, expected one of {', '.join(SEVERITIES)}")
        return cls(str(code), str(text), severity, None if camera is None else str(camera))


def worst_first(found: Iterable[Diagnostic]) -> list[Diagnostic]:
    """The same without repeats, faults before warnings before notes; else in the given order."""
    return sorted(dict.fromkeys(found), key=lambda one: SEVERITIES.index(one.severity))

"""`Diagnostic`: one thing that a person should know of a capture or of a fit, with a code for programs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal

from mifit.core.files import Document

Severity = Literal["fault", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("fault", "warning", "note")
"""The worst first."""


@dataclass(frozen=True)
class Diagnostic:
    """One finding: ``code`` says what it is, for programs, in words with hyphens, such as ``"camera-mirrored"``.

    ``text`` is a sentence or two: the figure found, what was expected, the remedy. ``"fault"``: the capture is wrong,
    and this names how; ``"warning"``: the result may be wrong; ``"note"``: a choice of the fit that a person may want
    to know of. ``camera`` is the one that it concerns, if it is one camera's.
    """

    code: str
    text: str
    severity: Severity = "warning"
    camera: str | None = None

    def __str__(self) -> str:
        return self.text

    def document(self) -> Document:
        """Plain values for JSON."""
        return asdict(self)

    @classmethod
    def of(cls, document: Document) -> Diagnostic:
        """From `document`; ValueError for another severity, KeyError for a missing key."""
        code, text, severity, camera = (document[key] for key in ("code", "text", "severity", "camera"))
        if severity not in SEVERITIES:
            raise ValueError(f"severity: found {severity!r}, expected one of {', '.join(SEVERITIES)}")
        return cls(str(code), str(text), severity, None if camera is None else str(camera))


def worst_first(found: Iterable[Diagnostic]) -> list[Diagnostic]:
    """The same without repeats, faults before warnings before notes; else in the given order."""
    return sorted(dict.fromkeys(found), key=lambda one: SEVERITIES.index(one.severity))

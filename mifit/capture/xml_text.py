"""XML of other programs, parsed without what makes XML dangerous."""

from __future__ import annotations

from xml.etree import ElementTree

from mifit.errors import InputError


def parse_xml(text: str, where: str) -> ElementTree.Element:
    """The root element of a document.

    A document type is refused: it is what entities are declared in, which expand without bound or name other files.
    None of the programs that are read here writes one.

    Parameters
    ----------
    text : str
        The document; its size is bounded where it was read.
    where : str
        For messages: what was read, and what it should be.

    Raises
    ------
    InputError
        A document type, or no well-formed XML.
    """
    if "<!DOCTYPE" in text:
        raise InputError(f"{where} (a document type, which is refused)")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{where} ({' '.join(str(error).split())[-80:]})") from None

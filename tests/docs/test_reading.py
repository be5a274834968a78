"""Pages are short, their links live, their pictures are made by this commit; notebooks say what they are for."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from mifit import __version__
from mifit.config import read_toml

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
WORDS, SENTENCE, METHOD, RELEASE = 16_000, 18, 600, 300
"""At most: words of all pages; mean words of a page's sentences; words of a page of the method, and of a release."""
LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)")
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)\s]+)\)")


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def prose(text: str) -> str:
    """A page without its code, tables, formulas and addresses."""
    for block in (r"```.*?```", r"<!--.*?-->", r"\$\$.*?\$\$", r"^    .*$", r"^\|.*$"):
        text = re.sub(block, "\n", text, flags=re.DOTALL if ".*?" in block else re.MULTILINE)
    text = re.sub(r"`[^`]*`|\$[^$]*\$", "X", PICTURE.sub("", text))
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)


def sentences(text: str) -> list[int]:
    """Words of each sentence: it ends with its mark, or with its paragraph, heading or item of a list."""
    parts = re.split(r"\n\s*\n|\n(?=\s*(?:[-*#]|\d+\.) )|(?<=[.!?])\s+(?=\S)", prose(text))
    lengths = [len(re.findall(r"[A-Za-z][\w'’-]*", part)) for part in parts]
    return [length for length in lengths if length > 2]


def anchors(path: Path) -> set[str]:
    """Anchors of a page's headings, as code hosts and mkdocs make them."""
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    titles = [re.sub(r"[^\w\s-]", "", title.lower()) for title in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    return {re.sub(r"\s+", "-", title.strip()) for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_sentences_are_short(page):
    lengths = sentences(page.read_text(encoding="utf-8"))
    assert not lengths or sum(lengths) / len(lengths) <= SENTENCE


def test_sentences_are_counted():
    text = "# A title of five words\n\nOne two [three](x.md) four. Five `six`\nseven eight?\n\n    no code\n\n"
    text += "- An item here\n"
    assert sentences(text) == [5, 4, 4, 3]


def test_pages_are_short():
    words = {page: len(page.read_text(encoding="utf-8").split()) for page in PAGES}
    assert sum(words.values()) <= WORDS
    long = {name: words[ROOT / "docs" / f"{name}.md"] for name in ("geometry", "surface", "reflectance", "normals")}
    assert max(long.values()) <= METHOD, long
    entries = re.findall(r"^- ", (ROOT / "docs" / "limits.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(entries) == 20


def test_every_release_is_short_and_the_last_one_is_this_version():
    releases = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    assert all(len(text.split()) <= RELEASE for text in releases)
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1]
    assert releases[0].split()[0] == __version__ == read_toml(ROOT / "pyproject.toml")["project"]["version"] == cited


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_live(page):
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if link.startswith("https://"):
            assert re.fullmatch(r"https://[\w.-]+\.\w+(/[^\s()]*)?", link), link
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link


def test_pictures_are_there_with_words_for_them_made_by_a_script_and_none_is_left_over():
    shown = set()
    for page in PAGES:
        for words, path in PICTURE.findall(page.read_text(encoding="utf-8")):
            shown.add((page.parent / path).resolve())
            assert words, path
    assert shown == {path for folder in ("images", "plugins") for path in (ROOT / "docs" / folder).glob("*.[!m]*")}
    scripts = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.py"))
    scripts += (ROOT / "benchmarks" / "speed.py").read_text(encoding="utf-8")
    made = {path.name for path in shown if path.name in scripts or f'"{path.stem}"' in scripts}
    assert made == {path.name for path in shown}


def test_six_notebooks_with_a_purpose_and_small_outputs():
    assert len(NOTEBOOKS) == 6
    for path in NOTEBOOKS:
        first, *rest = json.loads(path.read_text(encoding="utf-8"))["cells"]
        title, _, purpose = "".join(first["source"]).partition("\n")
        assert first["cell_type"] == "markdown" and title.startswith("# ") and len(purpose.split()) > 5, path.name
        assert any(cell.get("outputs") for cell in rest) and path.stat().st_size < 200_000, path.name

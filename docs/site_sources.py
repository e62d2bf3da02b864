"""A hook of mkdocs: files outside `docs/` that its pages link to are pages of the site, too.

In the repository `../examples/stream.py` is a link to a file. The site shows that file as a page of
its own, below `source/`. So every link works in both places, and none leads to another host.
"""

import json
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
# Relative ones: of Markdown, and of pictures in HTML.
LINK = re.compile(r'(\]\(|\bsrc(?:set)?=")((?!\w+:|#|/)[^)"\s#]+)((?:#[^)"\s]*)?[)"])')
FENCE = re.compile(r"^(```.*?^```|~~~.*?^~~~)", re.MULTILINE | re.DOTALL)
LANGUAGES = {".py": "python", ".cpp": "cpp", ".ts": "typescript", ".json": "json"}
# What is looked up by its code comes first in a search, files outside `docs/` come last.
BOOSTS = {"findings.md": 2, "errors.md": 2}
PICTURES = {".png", ".webp", ".gif", ".svg"}


def on_files(files: Files, /, *, config: MkDocsConfig) -> Files:
    """Add every file outside `docs/` that can be reached from its pages."""
    waiting = [Path("docs", page.src_uri) for page in files.documentation_pages()]
    known = set(waiting)
    while waiting:
        document = waiting.pop()
        if document.suffix != ".md":
            continue
        for target in targets(document, (ROOT / document).read_text(encoding="utf-8")):
            if target.parts[0] == "docs" or target in known:
                continue
            known.add(target)
            waiting.append(target)
            files.append(shown(target, config))
    return files


def on_page_markdown(text: str, /, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Have links lead to where their targets are on the site."""
    here = page.file.src_uri
    document = in_repository(here)
    page.meta["search"] = {"boost": BOOSTS.get(here, 0.5 if here.startswith("source/") else 1)}

    def moved(found: re.Match[str]) -> str:
        target = pointed_at(document, found[2])
        there = site_place(target)
        return f"{found[1]}{posixpath.relpath(there, posixpath.dirname(here) or '.')}{found[3]}"

    return "".join(
        part if part.startswith(("```", "~~~")) else LINK.sub(moved, part)
        for part in FENCE.split(text)
    )


def targets(document: Path, text: str) -> list[Path]:
    """Return the files that a document links to, from the repository's top."""
    return [pointed_at(document, found[2]) for found in LINK.finditer(FENCE.sub("", text))]


def pointed_at(document: Path, link: str) -> Path:
    """Return the file that a link in a document means; a folder means its README.

    Raises
    ------
    PluginError
        If there is no such file in the repository.
    """
    target = Path(posixpath.normpath(posixpath.join(document.parent.as_posix(), link)))
    if (ROOT / target).is_dir():
        target /= "README.md"
    if target.parts[0] == ".." or not (ROOT / target).is_file():
        raise PluginError(f"{document}: {link} is not in the repository")
    return target


def site_place(target: Path) -> str:
    """Return where a file of the repository is on the site, before it is made HTML."""
    if target.parts[0] == "docs":
        return target.relative_to("docs").as_posix()
    plain = target.suffix == ".md" or target.suffix in PICTURES
    return f"source/{target.as_posix()}{'' if plain else '.md'}"


def in_repository(place: str) -> Path:
    """Return the file of the repository that is shown at a place of the site."""
    if not place.startswith("source/"):
        return Path("docs", place)
    named = Path(place.removeprefix("source/"))
    return named if (ROOT / named).is_file() else named.with_suffix("")


def shown(target: Path, config: MkDocsConfig) -> File:
    """Return a file of the repository as a page of the site, or as the picture that it is."""
    place = site_place(target)
    out_of_nav = InclusionLevel.NOT_IN_NAV
    if target.suffix in PICTURES:
        return File.generated(config, place, abs_src_path=str(ROOT / target), inclusion=out_of_nav)
    text = (ROOT / target).read_text(encoding="utf-8")
    if target.suffix == ".ipynb":
        text = "\n\n".join(part for cell in json.loads(text)["cells"] for part in parts_of(cell))
    elif target.suffix != ".md":
        language = LANGUAGES.get(target.suffix, "text")
        text = f"# {target.as_posix()}\n\n~~~{language}\n{text.rstrip()}\n~~~\n"
    return File.generated(config, place, content=text, inclusion=out_of_nav)


def parts_of(cell: dict[str, Any]) -> list[str]:
    """Return a cell of a notebook, and what came of it, as parts of a document."""
    text = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [text]
    parts = [f"~~~python\n{text}\n~~~"]
    for output in cell["outputs"]:
        if "text" in output:
            parts.append(f"~~~text\n{''.join(output['text']).rstrip()}\n~~~")
        for kind, data in output.get("data", {}).items():
            if kind.startswith("image/"):
                content = "".join("".join(data).split())
                parts.append(f'<img alt="what the cell shows" src="data:{kind};base64,{content}">')
    return parts

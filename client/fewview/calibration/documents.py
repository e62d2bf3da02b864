"""The one door for the text of calibrations: read with bounds, before a parser has it.

A few hundred bytes of YAML may name each other until they fill all memory, and one key of TOML or
a thousand brackets take a parser down. No calibration needs any of that.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from fewview.errors import FormatError

MAX_BYTES = 2**22  # 500 cameras take a tenth of it
MAX_LINES_BYTES = 2**26  # of COLMAP, whose lists of images have the keypoints of each
MAX_NODES = 50_000  # values, lists and maps: 500 cameras have half of it
MAX_DEPTH = 16
MAX_KEY_PARTS = 5  # of a dotted key of TOML
MAX_SCALAR = 1024  # characters
# One without an end is taken up to where it breaks off, so that no text is looked at twice.
STRINGS = re.compile(r'"(?:[^"\\\n]|\\.)*+"?|\'[^\'\n]*+\'?')
COMMENTS = re.compile(r"#[^\n]*")
BRACKETS = re.compile(r"[\[\]{}]")
BETWEEN_KEYS = re.compile(r"[,\[\]{}=\n]+")
DRAWN = re.compile(r'"(?:[^"\\]|\\.)*+"?')  # of JSON, whose strings may hold brackets


def text_of(path: Path, limit: int = MAX_BYTES) -> str:
    """Return the text of a file of bounded size.

    Raises
    ------
    FormatError
        If it is larger, or no UTF-8.
    OSError
        If it cannot be read.
    """
    with path.open("rb") as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise FormatError(
            f"a calibration has {limit} bytes at most: is it another file?", place=path
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError("expected text in UTF-8; save it so", place=path) from error


def json_of(path: Path, text: str) -> Any:
    """Parse JSON; raise ``FormatError`` if it is broken, or nested beyond `MAX_DEPTH`."""
    _check_depth(path, DRAWN.sub("", text))
    try:
        return json.loads(text)
    except ValueError as error:
        raise FormatError(f"broken JSON ({error})", place=path) from error


def toml_of(path: Path, text: str) -> dict[str, Any]:
    """Parse TOML; raise ``FormatError`` if it is broken, or has what no calibration has."""
    if '"""' in text or "'''" in text:
        raise FormatError("texts of several lines are in no calibration: take them out", place=path)
    plain = COMMENTS.sub("", STRINGS.sub("s", text))
    _check_depth(path, plain)
    parts = BETWEEN_KEYS.split(plain)
    if max(part.count(".") for part in parts) >= MAX_KEY_PARTS:
        raise FormatError(f"a key has {MAX_KEY_PARTS} parts at most: name it plainly", place=path)
    if len(parts) > MAX_NODES:
        raise _too_many(path)
    try:
        return tomllib.loads(text)
    except ValueError as error:
        raise FormatError(f"broken TOML ({error})", place=path) from error


def yaml_of(path: Path, text: str) -> Any:
    """Parse YAML with OpenCV's matrices; raise ``FormatError`` as :func:`toml_of` does."""
    import yaml  # noqa: PLC0415  # not for everyone

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """A safe loader without aliases, which counts what it builds."""

        nodes = depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise FormatError("aliases (*name) are not read: write the values out", place=path)
            self.nodes += 1
            self.depth += 1
            if self.nodes > MAX_NODES:
                raise _too_many(path)
            if self.depth > MAX_DEPTH:
                raise _too_deep(path)
            node = super().compose_node(parent, index)
            if isinstance(node, yaml.ScalarNode) and len(node.value) > MAX_SCALAR:
                raise FormatError(f"a value has {MAX_SCALAR} characters at most", place=path)
            self.depth -= 1
            return node

    for tag in ("opencv-matrix", "opencv-nd-matrix"):
        Loader.add_constructor(
            f"tag:yaml.org,2002:{tag}",
            lambda reader, node: reader.construct_mapping(node, deep=True),
        )
    lines = text.splitlines()
    if lines and lines[0].startswith("%YAML"):  # OpenCV writes %YAML:1.0, which is none
        lines[0] = ""
    try:
        return yaml.load("\n".join(lines), Loader)  # noqa: S506  # a safe loader
    except (yaml.YAMLError, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"broken YAML ({error})", place=path) from error


def _check_depth(path: Path, plain: str) -> None:
    """Raise ``FormatError`` for brackets within brackets beyond `MAX_DEPTH`."""
    depth = 0
    for bracket in BRACKETS.findall(plain):
        depth += 1 if bracket in "[{" else -1
        if depth > MAX_DEPTH:
            raise _too_deep(path)


def _too_deep(path: Path) -> FormatError:
    return FormatError(
        f"values are nested {MAX_DEPTH} times at most: is it a calibration?", place=path
    )


def _too_many(path: Path) -> FormatError:
    return FormatError(
        f"more than {MAX_NODES} values are in no calibration: take out what is not of cameras",
        place=path,
    )

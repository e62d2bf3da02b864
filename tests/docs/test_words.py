"""How long README and the documents may be: nobody reads what is longer.

A word is what stands between blanks and has a letter or digit, in text, tables and code alike.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BUDGETS = {
    "README.md": 500,
    "docs/index.md": 400,
    "docs/tutorials": 4000,
    "docs/files.md": 1400,
    "docs/results.md": 900,
    "docs/labels.md": 700,
    "docs/page.md": 700,
    "docs/findings.md": 1500,
    "docs/api.md": 1200,
    "docs/errors.md": 600,
    "docs/clients.md": 300,
    "docs/streaming.md": 1500,
    "docs/live.md": 500,
    "docs/operations.md": 2400,
    "docs/queue.md": 500,
    "docs/settings.md": 1200,
    "docs/security.md": 800,
    "docs/method.md": 2500,
    "docs/fidelity.md": 2200,
    "docs/doubt.md": 900,
    "docs/performance.md": 1200,
    "docs/architecture.md": 2800,
    "docs/development.md": 1500,
}
MARGIN = 1.1
TOTAL = 32_000
LONGEST_PARAGRAPH = 120
NAMES = {str(page.relative_to(ROOT)): page for page in PAGES}
FENCE = re.compile(r"^ *(```|~~~).*?^ *\1", re.MULTILINE | re.DOTALL)
ITEM = re.compile(r"^ *(?:[*+-]|\d+\.) ", re.MULTILINE)


def words(text: str) -> int:
    return sum(any(letter.isalnum() for letter in part) for part in text.split())


def paragraphs(text: str) -> Iterator[str]:
    """Yield paragraphs and items of lists, without code, tables, headings and comments."""
    for block in re.split(r"\n\s*\n", FENCE.sub("\n\n", text)):
        lines = [line for line in block.splitlines() if not re.match(r" *(?:\||#|<)", line)]
        yield from ITEM.split("\n".join(lines))


@pytest.mark.parametrize("name", BUDGETS)
def test_a_page_is_as_short_as_its_budget(name: str) -> None:
    pages = [page for path, page in NAMES.items() if path == name or path.startswith(f"{name}/")]
    counted = sum(words(page.read_text()) for page in pages)
    assert 0 < counted <= MARGIN * BUDGETS[name]


def test_every_page_has_a_budget_and_all_together_are_short_enough() -> None:
    without = {name for name in NAMES if not {name, str(Path(name).parent)} & set(BUDGETS)}
    assert not without
    texts = [page.read_text() for page in PAGES]
    assert sum(len(text.split()) for text in texts) <= TOTAL  # bars of tables, too


@pytest.mark.parametrize("name", NAMES)
def test_no_paragraph_is_long(name: str) -> None:
    lengths = {part[:60]: words(part) for part in paragraphs(NAMES[name].read_text())}
    assert not {part: length for part, length in lengths.items() if length > LONGEST_PARAGRAPH}


def test_what_is_counted() -> None:
    text = (
        "# Title\n\nOne, two |\nthree.\n```sh\nfour\n```\n| five | six |\n* seven\n* eight nine\n"
    )
    assert [words(part) for part in paragraphs(text) if words(part)] == [3, 1, 2]
    assert words(text) == 11

"""Write the figures of benchmarks into docs/performance.md and evidence/speed.md, between marks.

    python benchmarks/tables.py lift.json load.json fit.json scaling.json runtimes.json

What `--json` wrote goes between `<!-- lift -->` and `<!-- /lift -->`; all bars of the files go
between `<!-- bars -->` and `<!-- /bars -->`.
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

from benchmarks.figures import Bar, Row, show

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "docs" / "performance.md", ROOT / "evidence" / "speed.md"]


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Write figures into the documents.")
    parser.add_argument("files", type=Path, nargs="+", help="what --json wrote")
    parser.add_argument(
        "--document", type=Path, action="append", help="default: performance.md and speed.md"
    )
    arguments = parser.parse_args()
    texts = {path: path.read_text() for path in arguments.document or DOCUMENTS}
    bars: list[Row] = []
    for path in arguments.files:
        results = json.loads(path.read_text())
        name = results["benchmark"]
        put(texts, name, section(results))
        for bar in results["bars"]:
            bar.pop("held")
            bars.append({"benchmark": name, **Bar(**bar).row()})
    if bars:
        put(texts, "bars", table(bars))
    for path, text in texts.items():
        path.write_text(text)


def section(results: dict[str, Any]) -> str:
    """Return where it was measured, then the tables, as Markdown."""
    machine = results["machine"]
    about = f"{machine['processor']}, {machine['cores']} cores"
    if machine["instructions"]:
        about += f", {machine['instructions'][-1]}"
    about += f"; torch {machine['torch']}, Python {machine['python']}."
    parts = [f"**{title}**\n\n{table(rows)}" for title, rows in results["tables"].items()]
    return "\n\n".join([about, *parts])


def table(rows: list[Row]) -> str:
    """Return rows that have the same columns as a Markdown table."""
    names = list(rows[0])
    numbers = [all(isinstance(row[name], int | float | None) for row in rows) for name in names]
    lines = [names, ["--:" if number else "---" for number in numbers]]
    lines += [[show(row[name]) for name in names] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def put(texts: dict[Path, str], name: str, new: str) -> None:
    """Put something new between the marks of this name, in the document that has them."""
    first, last = f"<!-- {name} -->", f"<!-- /{name} -->"
    pattern = re.compile(re.escape(first) + ".*?" + re.escape(last), re.DOTALL)
    for path, text in texts.items():
        if pattern.search(text):
            texts[path] = pattern.sub(lambda _: f"{first}\n{new}\n{last}", text)
            return
    sys.exit(f"no document has a place for `{name}`: {first} ... {last}")


if __name__ == "__main__":
    main()

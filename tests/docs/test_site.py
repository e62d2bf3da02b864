"""The site of docs/: every link leads somewhere, and no page asks another host."""

import json
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from models.findings.catalogue import CODES
from service.http.errors import PROBLEMS
from tests.node import NODE

ROOT = Path(__file__).parents[2]
# What a browser loads by itself, by the attribute that has the address.
LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "srcset", "video": "src"}
FOREIGN = re.compile(r"\s*(?:https?:)?//")

pytest.importorskip("material", reason="mkdocs-material is not installed")


def build(project: Path, site: Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]
    return subprocess.run(
        command,
        cwd=project,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


class Loads(HTMLParser):
    """Collects what a page loads when it is opened."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.classes: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.classes.update((given.get("class") or "").split())
        where = "href" if tag == "link" and given.get("rel") != "canonical" else LOADED.get(tag)
        if where is not None and given.get(where):
            self.addresses.append(str(given[where]))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the site."""
    folder = tmp_path_factory.mktemp("site") / "site"
    built = build(ROOT, folder)
    assert built.returncode == 0, built.stderr
    return folder


class Links(HTMLParser):
    """Collects where a page leads."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "a":
            self.addresses.add(str(dict(attrs).get("href")))


def test_the_search_finds_every_finding_and_every_error(site: Path) -> None:
    titles = [title for _status, title in PROBLEMS.values()]
    sought = [*CODES, *PROBLEMS, *titles]
    done = subprocess.run(
        [NODE, str(Path(__file__).with_name("search.mjs")), str(site)],
        input=json.dumps(sought),
        capture_output=True,
        text=True,
        check=True,
    )
    found: dict[str, list[str]] = json.loads(done.stdout)
    expected = dict.fromkeys(CODES, "findings.html") | dict.fromkeys(PROBLEMS, "errors.html")
    expected |= dict.fromkeys(titles, "errors.html")
    missed = {}
    for query, page in expected.items():
        pages = list(dict.fromkeys(place.partition("#")[0] for place in found[query]))
        if page not in pages[:5]:  # what is seen without scrolling
            missed[query] = pages[:5]
    assert not missed


def test_the_first_page_leads_to_what_newcomers_look_for(site: Path) -> None:
    links = Links()
    links.feed((site / "index.html").read_text(encoding="utf-8"))
    assert {
        "api.html#how-to-give-a-lens",
        "findings.html",
        "streaming.html#frames-and-answers-as-bytes",
        "development.html",  # how to add a format
    } <= links.addresses


def test_the_site_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert {site / "tutorials" / "sleap.html", site / "source" / "client" / "index.html"} < set(
        pages
    )
    for page in pages:
        seen = Loads()
        seen.feed(page.read_text(encoding="utf-8"))
        assert seen.addresses
        assert not [address for address in seen.addresses if FOREIGN.match(address)]
        assert "mermaid" not in seen.classes  # its script would come from another host
        for address in seen.addresses:
            if not address.startswith(("data:", "/")):  # 404.html is for any folder
                assert (page.parent / address.partition("#")[0].partition("?")[0]).exists()
    for sheet in site.rglob("*.css"):
        addresses = re.findall(r"(?:url\(|@import)\s*[\"']?([^\"')]+)", sheet.read_text())
        assert not [address for address in addresses if FOREIGN.match(address)]


@pytest.mark.parametrize(
    "links",
    [
        ["../examples/nothing.py"],
        ["nothing.md"],
        ["files.md#nothing", "../client/README.md#nothing"],  # which end the build at its end
    ],
)
def test_a_link_that_leads_nowhere_fails(links: list[str], tmp_path: Path) -> None:
    for file in ROOT.iterdir():
        if file.name not in {"docs", "build", ".git", ".venv"}:
            (tmp_path / file.name).symlink_to(file)
    shutil.copytree(ROOT / "docs", tmp_path / "docs")
    with (tmp_path / "docs" / "page.md").open("a") as page:
        page.writelines(f"\n[a link]({link})\n" for link in links)
    built = build(tmp_path, tmp_path / "site")
    assert built.returncode != 0
    for link in links:
        assert link.removeprefix("../") in built.stderr

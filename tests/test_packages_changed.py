"""Which tests `make check` runs."""

from pathlib import Path

import pytest

from tests.packages_changed import ROOT, where_tested


@pytest.mark.parametrize(
    ("file", "tests"),
    [
        ("models/bundle/frame.py", "tests/models/bundle"),
        ("models/optics/lenses/pinhole.py", "tests/models/optics"),
        ("store/fits.py", "tests/store"),
        ("worker/new/room.py", "tests/worker"),
        ("benchmarks/lift.py", "tests/benchmarks"),
        ("tests/store/test_fits.py", "tests/store/test_fits.py"),
        ("tests/store/test_that_was_deleted.py", None),
        ("tests/worker/conftest.py", "tests/worker"),
        ("tests/processes.py", "tests"),
        ("docs/method.md", None),
        ("tests/fixtures/README.md", None),
        ("Makefile", None),
    ],
)
def test_a_file_is_tested_by_the_where_tested_its_room(file: str, tests: str | None) -> None:
    assert where_tested(Path(file)) == (None if tests is None else ROOT / tests)

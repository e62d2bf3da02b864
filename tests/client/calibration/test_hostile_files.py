"""Hostile calibrations end in a message within bounds of memory and time, whatever their format."""

import subprocess
import sys
from pathlib import Path

YAML = "%YAML:1.0\n---\n"
LAUGHS = "a0: &a0 [x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 12)
)


def opencv(**fields: object) -> str:
    given = {"camera_matrix": [[1000, 0, 500], [0, 1000, 500], [0, 0, 1]], **fields}
    return "cameras:\n  - {" + ", ".join(f"{k}: {v}" for k, v in given.items()) + "}\n"


def anipose(**fields: object) -> str:
    given = {"matrix": [[1000, 0, 500], [0, 1000, 500], [0, 0, 1]], **fields}
    return "[cam_0]\n" + "".join(f"{name} = {value}\n" for name, value in given.items())


LENS = "1 PINHOLE 640 480 {} 500 320 240\n"
HOSTILE: dict[str, tuple[str, str]] = {
    "laughs.yml": (LAUGHS, "aliases"),
    "itself.yml": ("cameras: &a [*a]\n", "aliases"),
    "deep.yml": (YAML + "[" * 100_000, "nested"),
    "deep_blocks.yml": (YAML + "- " * 50_000 + "1\n", "nested"),
    "many.yml": ("cameras:\n" + "- {k: 1}\n" * 200_000, "more than"),
    "sixties.yml": ("k: " + "1:" * 300_000 + "1\n", "characters at most"),
    "huge.yml": ("#" * 5_000_000, "bytes at most"),
    "tagged.yml": ("k: !!python/object/apply:os.system [id]\n", "broken YAML"),
    "digits.yml": ("k: " + "1" * 1000 + "\n", "no cameras"),
    "key.toml": (".".join("a" * 30_000) + " = 1\n", "parts at most"),
    "quoted_key.toml": (".".join(['"a"'] * 20_000) + " = 1\n", "parts at most"),
    "inline_key.toml": ("k = {" + ".".join("a" * 30_000) + " = 1}\n", "parts at most"),
    "hidden_key.toml": (f"k = {{x = '''\"''', {'.'.join('a' * 9_000)} = 1}}", "several lines"),
    "header.toml": (f"[{'.'.join('a' * 30_000)}]\n", "parts at most"),
    "deep.toml": ("k = " + "[" * 50_000, "nested"),
    "many.toml": ("".join(f"[a{n}.b.c]\n" for n in range(100_000)), "more than"),
    "deep.json": ('{"cameras": ' + "[" * 100_000, "nested"),
    "digits.json": ('{"k": ' + "1" * 100_000 + "}", "broken JSON"),
    "infinite.json": ('{"camera_matrix": [[Infinity,0,1],[0,1,1],[0,0,1]]}', "finite"),
    "infinite.toml": (anipose(matrix="[[inf, 0, 1], [0, 1, 1], [0, 0, 1]]"), "finite"),
    "infinite.yml": (opencv(camera_matrix="[[.inf,0,1],[0,1,1],[0,0,1]]"), "finite"),
    "negative.yml": (opencv(camera_matrix="[[-9,0,1],[0,9,1],[0,0,1]]"), "focal"),
    "unmeasured.yml": (opencv(distortion_coefficients="[.nan, 0, 0, 0, 0]"), "distortion"),
    "sheared.yml": (
        opencv(rotation="[[1,1,0],[0,1,0],[0,0,1]]", translation="[0,0,1]"),
        "orthonormal",
    ),
    "mirrored.toml": (
        anipose(rotation="[[1,0,0],[0,1,0],[0,0,-1]]", translation="[0, 0, 1]"),
        "determinant",
    ),
    "large.toml": (anipose(size="[9999999, 480]"), "size"),
    "named.toml": (anipose(name='"' + "x" * 900 + '"'), "name has"),
    "colmap": (LENS.format("inf"), "finite"),
    "colmap_0": (LENS.format("0"), "focal"),
}


def test_every_hostile_file_is_refused_with_file_and_remedy(tmp_path: Path) -> None:
    for name, (text, _) in HOSTILE.items():
        if name.startswith("colmap"):
            (tmp_path / name).mkdir()
            (tmp_path / name / "cameras.txt").write_text(text)
            (tmp_path / name / "images.txt").write_text("")
        else:
            (tmp_path / name).write_text(text)
    read = subprocess.run(
        [sys.executable, "-P", "-m", "tests.client.calibration.hostile_reading", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert read.returncode == 0, read.stderr[-2000:]
    messages = dict(line.split("\t", 1) for line in read.stdout.splitlines())
    assert messages.keys() == HOSTILE.keys()
    for name, (_, expected) in HOSTILE.items():
        assert expected in messages[name], (name, messages[name])
        assert messages[name].startswith(str(tmp_path / name)), messages[name]
        assert len(messages[name]) < 1000, name

"""Files as detectors write them, sent in a form, one for each camera."""

import io
import json
import pickle
import re
from pathlib import Path
from typing import Any

import h5py
import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient

from tests.client.readers import files
from tests.client.readers.test_hdf5_of_others import nwb
from tests.service.conftest import problem, zip_of

NAMES = files.NAMES
LEFT, RIGHT = files.walk(12), files.walk(12, start=200, seed=2)
Parts = list[tuple[str, tuple[str, bytes]]]


def table(path: Path, values: Any) -> bytes:
    return files.dlc_csv(path, files.columns(NAMES), values.reshape(len(values), -1)).read_bytes()


def parts(**named: bytes) -> Parts:
    """Return files of a form; their names are those of the arguments, with a point for `_`."""
    return [("files", (name.replace("_", ".", 1), data)) for name, data in named.items()]


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Parts:
    folder = tmp_path_factory.mktemp("tables")
    return parts(left_csv=table(folder / "a", LEFT), right_csv=table(folder / "b", RIGHT))


def openpose(frames: Any) -> bytes:
    """Return a zip of a file for each frame."""
    return zip_of(
        {
            f"cam/cam_{n:012}_keypoints.json": json.dumps(
                {"people": [{"pose_keypoints_2d": frame.ravel().tolist()}]}
            ).encode()
            for n, frame in enumerate(frames)
        }
    )


def send(api: TestClient, sent: Parts, **fields: str) -> dict[str, Any]:
    answer = api.post("/datasets", files=sent, data=fields)
    assert answer.status_code == 201, answer.text
    made: dict[str, Any] = answer.json()
    assert api.get(f"/datasets/{made['id']}").json() == made
    return made


def refused(answer: httpx2.Response, field: str = "files") -> str:
    return problem(answer, 422, "invalid_input", f"/{field}")


def test_an_nwb_of_two_cameras_with_links_and_a_calibration(
    api: TestClient, tmp_path: Path
) -> None:
    made = send(api, parts(session_nwb=nwb(tmp_path / "a.nwb").read_bytes()))
    assert (made["frames"], made["views"], made["keypoints"]) == (12, 2, 4)
    assert made["view_names"] == ["cam1", "cam2"]
    assert made["calibration"]["names"] == ["cam1", "cam2"]


def test_cameras_in_the_names_of_keypoints(api: TestClient, tmp_path: Path) -> None:
    names = [f"{word}_{name}" for word in ("real", "mirror") for name in NAMES]
    both = np.concatenate([LEFT, RIGHT], axis=1).reshape(12, -1)
    sent = parts(rat_csv=files.dlc_csv(tmp_path / "a", files.columns(names), both).read_bytes())
    assert send(api, sent)["view_names"] == ["real", "mirror"]
    assert send(api, sent, views_in_names="none")["views"] == 1


def test_tables_of_two_cameras(api: TestClient, tables: Parts) -> None:
    made = send(api, tables, name="walk", fps="50", metadata='{"subject": "M7"}')
    assert [made[k] for k in ("name", "frames", "views", "keypoints", "fps")] == [
        "walk", 12, 2, 4, 50,
    ]  # fmt: skip
    assert made["view_names"] == ["left", "right"]
    assert made["skeleton"]["keypoint_names"] == list(NAMES)
    assert made["metadata"] == {"subject": "M7"}
    assert made["notes"] == ["read as DeepLabCut CSV"]
    assert made["missing_fraction"] == [0, 0]
    # The same as arrays.
    buffer = io.BytesIO()
    both = np.stack([LEFT, RIGHT], 1).astype(np.float32)
    np.savez(buffer, keypoints=both[..., :2], confidence=both[..., 2])
    posted = api.post("/datasets", files={"file": ("capture.npz", buffer.getvalue())})
    assert posted.json()["checksum"] == made["checksum"]  # by its fps, and no times
    assert not made["has_times"]


def test_reading_options_are_in_the_form(api: TestClient, tables: Parts) -> None:
    seen = np.mean([LEFT[..., 2] >= 0.8, RIGHT[..., 2] >= 0.8], (1, 2))
    made = send(api, tables, min_confidence="0.8", format="deeplabcut-csv")
    np.testing.assert_allclose(made["missing_fraction"], 1 - seen, atol=1e-6)
    assert any("below 0.8 are gaps" in note for note in made["notes"])
    one = send(api, tables, cameras="right", y="up", image_sizes="[[640, 480]]")
    assert one["view_names"] == ["right"]
    assert any("y is" in note for note in one["notes"])
    names = ("nase", "ohr", "füße", "hand")
    german = ";".join(["Nr", *(f"{axis} von {name}" for name in names for axis in "xy")]) + "\n"
    german += "".join(f"{n};" + ";".join(["1,5", str(20 + n)] * 4) + "\n" for n in range(4))
    for encoding in ("utf-8-sig", "utf-16", "utf-16-le", "utf-32", "cp1252"):
        sent = parts(a_csv=german.encode(encoding))
        mapped = send(api, sent, table_columns="x=x von {},y=y von {},frame=Nr")
        assert mapped["skeleton"]["keypoint_names"] == list(names)
    for field, wrong in (
        ("y", "left"),
        ("format", "dlc"),
        ("min_confidence", "2"),
        ("align", "name"),
        ("fps", "fast"),
    ):
        answer = api.post("/datasets", files=tables, data={field: wrong})
        problem(answer, 422, "invalid_input", f"/{field}")
    answer = api.post("/datasets", files=tables, data={"skeleton": "cat"})
    assert "there is no skeleton 'cat'; there are coco-17" in refused(answer, "skeleton")
    answer = api.post("/datasets", files=tables, data={"min_confidense": "0.1"})
    message = problem(answer, 422, "invalid_input", "/min_confidense")
    assert "did you mean 'min_confidence'" in message


@pytest.mark.usefixtures("unchanged")
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("person", "7"),
        ("person", "0,0,0"),
        ("cameras", "left,behind"),
        ("mirror", "behind"),
        ("offset", "behind=560,180"),
        ("offset_seconds", "left=soon"),
        ("views_in_names", "real,mirror"),
        ("trial", "walk2"),
        ("table_columns", "x={}_u,y={}_v"),
        ("align", "time"),  # without times
    ],
)
def test_errors_name_the_field_that_is_wrong(
    api: TestClient, tables: Parts, field: str, value: str
) -> None:
    message = refused(
        api.post("/datasets", files=tables, data={field: value}),
        "fps" if field == "align" else field,
    )
    assert "--" not in message


@pytest.mark.usefixtures("unchanged")
def test_errors_name_fields_and_leave_other_words(api: TestClient, tables: Parts) -> None:
    answer = api.post("/datasets", files=tables, data={"format": "csv"})
    assert "has no columns of x and y" in refused(answer, "table_columns")
    answer = api.post("/datasets", files=tables, data={"table_columns": "x={}_u,y={}_v"})
    assert "table_columns: no column matches" in refused(answer, "table_columns")


def test_a_zip_file_is_a_folder_of_frames(api: TestClient) -> None:
    left, right = files.walk(5, 25), files.walk(5, 25, start=300, seed=2)
    sent = parts(left_zip=openpose(left), right_zip=openpose(right))
    made = send(api, sent, skeleton="body-25b")
    assert (made["frames"], made["views"], made["keypoints"]) == (5, 2, 25)
    assert made["view_names"] == ["left", "right"]
    assert "Head" in made["skeleton"]["keypoint_names"]


def test_landmarks_use_the_given_sizes(api: TestClient) -> None:
    frames = [[{"x": 0.1 * k, "y": 0.05 * n} for k in range(1, 6)] for n in range(1, 5)]
    sent = parts(left_json=json.dumps(frames).encode(), right_json=json.dumps(frames).encode())
    message = refused(api.post("/datasets", files=sent), "image_sizes")
    assert "image's width" in message
    assert "give image_sizes for each view, such as [[1920, 1080]" in message
    made = send(api, sent, image_sizes="[[1920, 1080], [1280, 720]]")
    assert made["image_sizes"] == [[1920, 1080], [1280, 720]]


@pytest.mark.usefixtures("unchanged")
def test_what_has_to_be_trusted_is_refused_and_says_what_to_do(
    api: TestClient, tables: Parts
) -> None:
    authors = pickle.dumps({"W_GT": np.zeros((4, 2, 5)), "S_GT": np.zeros((4, 3, 5))})
    c3d = b"\x02\x50" + bytes(1024)
    for sent in (
        parts(cam_c3d=c3d, other_c3d=c3d),
        parts(CAM_pkl=authors),
        parts(cams_zip=zip_of({"a.c3d": c3d})),
    ):
        assert "fewview convert" in refused(api.post("/datasets", files=sent))


def hostile(tmp_path: Path) -> dict[str, bytes]:
    """Return files that are broken, or that ask for far more than they hold."""
    promised = tmp_path / "promised.h5"
    with h5py.File(promised, "w") as file:  # 2 KiB that unpack to 3.8 GB
        file.create_dataset("tracks", (2, 2, 4, 30_000_000), "f8", compression="gzip", chunks=True)
        file["node_names"] = [b"a", b"b", b"c", b"d"]
    outside = tmp_path / "outside.h5"
    with h5py.File(outside, "w") as file:
        elsewhere = [("/etc/passwd", 0, h5py.h5s.UNLIMITED)]
        file.create_dataset("tracks", (1, 2, 4, 12), "f8", external=elsewhere)
        file["node_names"] = [b"a", b"b", b"c", b"d"]
    cut = files.dlc_h5_fixed(tmp_path / "cut.h5", files.columns(NAMES), LEFT.reshape(12, 12))
    nested = b'{"people": [' + b"[" * 100_000
    filtered = tmp_path / "filtered.h5"  # by a plugin that is looked for in a folder
    with h5py.File(filtered, "w") as file:
        kept = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        kept.set_chunk((1, 2, 4, 10))
        kept.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, ())
        space = h5py.h5s.create_simple((1, 2, 4, 10))
        tracks = h5py.h5d.create(file.id, b"tracks", h5py.h5t.NATIVE_DOUBLE, space, kept)
        tracks.write_direct_chunk((0, 0, 0, 0), b"packed", 0)
        file["node_names"] = [b"a", b"b", b"c", b"d"]
    return {
        "filtered.h5": filtered.read_bytes(),
        "long.zip": zip_of({f"cam/{'n' * 300}.csv": b"0,1"}),
        "twice.zip": zip_of({"cam": b"0,1", "cam/a.csv": b"0,1"}),
        "promised.h5": promised.read_bytes(),
        "outside.h5": outside.read_bytes(),
        "cut.h5": cut.read_bytes()[:3000],
        "noise.h5": b"\x89HDF\r\n\x1a\n" + bytes(range(256)) * 20,
        "nested.json": nested,
        "words.csv": b"scorer,a\nbodyparts,nose\ncoords,x\n0,hello\n",
        "empty.csv": b"",
        "bomb.zip": zip_of({"a/big.csv": b"0,1\n" * 2**20, "a/bigger.csv": bytes(2**26)}),
        "broken.zip": openpose(files.walk(4, 25))[:-40],
        "nothing.zip": zip_of({"readme.txt": b"no keypoints"}),
    }


@pytest.mark.usefixtures("unchanged")
def test_hostile_and_broken_files_are_named(api: TestClient, tables: Parts, tmp_path: Path) -> None:
    for name, data in hostile(tmp_path).items():
        answer = api.post("/datasets", files=[("files", (name, data)), tables[0]])
        message = refused(answer)
        assert name.partition(".")[0] in message, message
        assert "fewview-" not in message, message  # the service's own folder
        assert not re.search(r"(^|[\s'\"(=])/\w", message), message  # nor any other
        too_much = name in ("promised.h5", "bomb.zip")
        assert ("FEWVIEW_MAX_UNPACKED_BYTES" in message) == too_much, message


def test_text_of_files_cannot_break_the_answer(api: TestClient) -> None:
    """Halves of characters cannot be sent, and names may be of any length."""

    def coco(*names: str) -> bytes:
        values = [coordinate for k in range(len(names)) for coordinate in (9.0 * k, 5.0, 2)]
        content = {
            "images": [{"id": n, "file_name": f"{n}.png"} for n in (1, 2)],
            "categories": [{"keypoints": names, "skeleton": []}],
            "annotations": [{"image_id": n, "keypoints": values} for n in (1, 2)],
        }
        return json.dumps(content).encode()

    for odd in ("\ud800", "n" * 100_000):
        for other in (coco(*NAMES), coco(odd)):
            answer = api.post("/datasets", files=parts(a_json=coco(*NAMES, odd), b_json=other))
            assert answer.status_code == 422, answer.text
            assert len(answer.text) < 5000


@pytest.mark.usefixtures("unchanged")
def test_how_many_and_how_much_is_bounded(api: TestClient, tables: Parts, tmp_path: Path) -> None:
    answer = api.post("/datasets", files=[tables[0]] * 5)  # the service takes 4 views
    assert answer.status_code == 400
    long = table(tmp_path / "long.csv", files.walk(401))
    answer = api.post("/datasets", files=parts(a_csv=long, b_csv=long))
    assert "at most 400 frames" in problem(answer, 422, "invalid_input", "/keypoints")


def test_bodies_that_should_be_files_say_how_to_send_them(api: TestClient, tables: Parts) -> None:
    for data, what in (
        (tables[0][1][1], "text, such as CSV"),
        (b"\x89HDF\r\n\x1a\n" + bytes(99), "an HDF5 file"),
        (b'[{"image_id": 1}]', "JSON"),
    ):
        headers = {"Content-Type": "application/octet-stream"}
        answer = api.post("/datasets", content=data, headers=headers)
        message = problem(answer, 400, "malformed_body")
        assert what in message
        assert "curl -F files=@cam1.csv" in message
    of_detectors: list[Any] = [{"people": []}, [{"image_id": 1, "keypoints": [1, 2, 3]}]]
    for body in of_detectors:
        answer = api.post("/datasets", json=body)
        assert "-F files=@" in problem(answer, 422, "invalid_input")
    answer = api.post("/datasets", content=b"a,b", headers={"Content-Type": "text/csv"})
    assert "-F files=@" in problem(answer, 415, "unsupported_media_type")


def test_a_request_sent_again_makes_one_dataset(api: TestClient, tables: Parts) -> None:
    key = {"Idempotency-Key": "files-1"}
    first = api.post("/datasets", files=tables, headers=key)
    assert api.post("/datasets", files=tables, headers=key).json() == first.json()
    other = [tables[0], ("files", ("other.csv", tables[1][1][1]))]
    answer = api.post("/datasets", files=other, headers=key)
    problem(answer, 422, "idempotency_key_reused")


def test_names_may_be_long_and_the_same(api: TestClient, tables: Parts) -> None:
    left, right = (data for _, (_, data) in tables)
    for names in (["漢" * 200, "漢" * 200 + ".csv"], ["a", "2_a", "a"], ["out", "..", "../.."]):
        sent = [("files", (name, (left, right)[n % 2])) for n, name in enumerate(names)]
        made = send(api, sent)
        assert made["views"] == len(names)
        assert len(set(made["view_names"])) == len(names)


def test_a_form_has_one_file_of_arrays_or_files_of_detectors(
    api: TestClient, tables: Parts
) -> None:
    arrays = io.BytesIO()
    np.savez(arrays, keypoints=np.stack([LEFT, RIGHT], 1)[..., :2].astype(np.float32))
    file = ("file", ("capture.npz", arrays.getvalue()))
    problem(api.post("/datasets", files=[file, *tables]), 400, "malformed_body")
    problem(api.post("/datasets", files=[file, file]), 400, "malformed_body")
    answer = api.post("/datasets", files=[file], data={"min_confidence": "0.3"})
    problem(answer, 422, "invalid_input", "/min_confidence")
    assert api.post("/datasets", files=[("files", file[1])]).status_code == 201
    _, table = tables[0]
    answer = api.post("/datasets", files=[("file", table)])
    assert "files=@cam1.csv" in problem(answer, 400, "malformed_body")

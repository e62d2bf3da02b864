"""One room for all frames: a drawn walk comes back from frames that turn with the subject."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview.calibration import Camera
from fewview.geometry.placing import in_room
from fewview.room import Room, to_room
from numpy.typing import NDArray
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation

Float64 = NDArray[np.float64]
FIXTURES = Path(__file__).parent.parent / "fixtures"
NAMES = ("head", "hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
TILT = Rotation.from_euler("xz", [20, 4], degrees=True).as_matrix()  # of the first camera


@dataclass
class Walk:
    """A walk in the axes of the first camera, and its lift."""

    truth: Float64
    points3d: Float64
    rotations: Float64
    translations: Float64
    models: NDArray[np.int8]
    up: Float64

    def room(self, **more: object) -> Room:
        return to_room(
            self.points3d,
            self.rotations,
            self.translations,
            self.models,
            **more,  # type: ignore[arg-type]
        )


@pytest.fixture
def walk() -> Walk:
    rng = np.random.default_rng(3)
    n = 80
    body = np.array(
        [[0, 1.7, 0], [0, 1, 0], [0.1, 0.5, 0], [-0.1, 0.5, 0], [0.1, 0, 0], [-0.1, 0, 0]]
    )
    phase = np.linspace(0, 6 * np.pi, n)
    walking = np.tile(body, (n, 1, 1))
    walking[:, 4, 1] += np.maximum(np.sin(phase), 0) * 0.2
    walking[:, 5, 1] += np.maximum(-np.sin(phase), 0) * 0.2
    path = np.stack((1.5 * np.cos(phase / 3), np.zeros(n), 1.5 * np.sin(phase / 3)), -1)
    level = walking + path[:, None]  # y up, the floor at 0
    to_camera = TILT @ np.diag([1.0, -1.0, -1.0])  # y down, z forward
    truth = level @ to_camera.T + [0.2, 1.0, 6.0]
    rig = [(np.eye(3), np.zeros(3))]
    for angle in (80, -120):
        turn = Rotation.from_euler("y", angle, degrees=True).as_matrix()
        rig.append((turn, np.array([0.0, 0.1, 6.0]) - turn @ np.array([0.0, 0.0, 6.0])))
    canonical = Rotation.random(n, rng=rng).as_matrix()
    centre = truth.mean(1)
    points3d = np.einsum("nji,npj->npi", canonical, truth - centre[:, None])
    rotations = np.stack([turn @ canonical for turn, _ in rig], 1)
    translations = np.stack([centre @ turn.T + shift for turn, shift in rig], 1)
    models = np.ones((n, 3), np.int8)
    return Walk(truth, points3d, rotations, translations, models, to_camera @ [0, 1, 0])


def test_a_walk_walks(walk: Walk) -> None:
    room = walk.room()
    np.testing.assert_allclose(room.points, walk.truth, atol=1e-9)
    assert (room.missing, room.notes) == (0, ())
    assert np.ptp(walk.points3d.mean(1), axis=0).max() < 1e-9  # the lift itself stays in place


def test_views_that_are_missing_or_contradict_do_no_harm(walk: Walk) -> None:
    turned = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    walk.rotations[5, 1] = walk.rotations[5, 1] @ turned  # one view of three
    walk.translations[6, 2] += 3
    walk.models[7, 0] = -1  # the reference has no camera here
    walk.models[8, 1:] = -1
    walk.models[9] = 0  # weak perspective
    walk.translations[10] = np.nan
    room = walk.room()
    there = np.delete(np.arange(80), [9, 10])
    np.testing.assert_allclose(room.points[there], walk.truth[there], atol=1e-9)
    assert np.isnan(room.points[9:11]).all()
    np.testing.assert_array_equal(np.isnan(room.scales), ~np.isin(np.arange(80), there))
    assert room.missing == 2
    assert "2 of 80" in room.notes[0]
    assert "in 2 frames" in room.notes[1]


def test_frames_in_units_of_a_moving_view_are_scaled_by_the_rig(walk: Walk) -> None:
    units = np.exp(np.random.default_rng(0).normal(0, 0.2, 80))
    walk.points3d *= units[:, None, None]
    walk.translations *= units[:, None, None]
    room = walk.room()
    ratios = room.points / walk.truth
    np.testing.assert_allclose(ratios, ratios[0, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(room.scales * units, ratios[0, 0, 0], rtol=1e-6)
    turns = [np.eye(3), *room.rotations[1:]]
    rig = [Camera(str(v), np.eye(3), np.zeros(0), turns[v], room.translations[v]) for v in range(3)]
    np.testing.assert_allclose(walk.room(cameras=rig).points, room.points, atol=1e-9)


def test_a_view_that_moves_is_not_asked(walk: Walk) -> None:
    wild = Rotation.random(80, rng=np.random.default_rng(1)).as_matrix()
    walk.rotations[:, 2] = wild @ walk.rotations[:, 2]
    room = walk.room()
    np.testing.assert_allclose(room.points, walk.truth, atol=1e-9)
    assert np.isnan(room.rotations[2]).all()
    alone = walk.room(reference=2)
    assert "the room is its own" in alone.notes[0]


def test_cameras_that_were_given_say_the_room(walk: Walk) -> None:
    found = walk.room()
    turn = Rotation.from_euler("xyz", [40, 10, -70], degrees=True).as_matrix()
    given = [
        Camera(str(v), np.eye(3), np.zeros(0), found.rotations[v] @ turn, found.translations[v])
        for v in range(3)
    ]
    own = walk.room(cameras=given, reference=None)
    np.testing.assert_allclose(own.points, walk.truth @ turn, atol=1e-9)
    second = walk.room(cameras=given, reference=1).points
    np.testing.assert_allclose(second, walk.room(reference=1).points, atol=1e-9)


def test_up_and_the_floor(walk: Walk) -> None:
    given = walk.room(up=walk.up, keypoint_names=NAMES)
    found = walk.room(up="auto", keypoint_names=NAMES)
    assert "plane of the feet" in found.notes[0]
    for room in (given, found):
        assert abs(room.points[:, 4:, 1].min()) < 0.02
        np.testing.assert_allclose(room.points[:, 0, 1], 1.7, atol=0.02)
        assert np.linalg.det(room.rotations[0]) == pytest.approx(1)
        camera = np.einsum("kij,npj->knpi", room.rotations, room.points)
        camera += room.translations[:, None, None]
        np.testing.assert_allclose(camera[0], walk.truth, atol=1e-9)
    nameless = walk.room(up="auto").points
    rise = nameless[:, 0] - nameless[:, 1]
    assert np.all(rise[:, 1] / np.linalg.norm(rise, axis=-1) > 0.99)
    assert abs(walk.room(up=walk.up, keypoint_names=NAMES, floor=False).points[:, 4:, 1].min()) > 1


def test_feet_in_one_place_leave_up_to_the_body(walk: Walk) -> None:
    truth = walk.truth - walk.truth.mean(1, keepdims=True) + [0, 0, 6]
    one = np.broadcast_to(np.eye(3), (80, 1, 3, 3))
    room = to_room(truth, one, np.zeros((80, 1, 3)), up="auto", keypoint_names=NAMES)
    assert "seen from its feet" in room.notes[0]
    rise = room.points[:, 0] - room.points[:, 1]
    assert np.all(rise[:, 1] / np.linalg.norm(rise, axis=-1) > 0.99)


def test_what_cannot_be_is_refused(walk: Walk) -> None:
    with pytest.raises(ValueError, match="expected"):
        to_room(walk.points3d, walk.rotations[:5], walk.translations)
    for more, why in (
        ({"up": "north"}, "auto"),
        ({"up": (0, 0, 0)}, "other than zero"),
        ({"floor": True}, "needs `up`"),
        ({"floor": True, "up": (0, -1, 0)}, "feet"),
        ({"reference": None}, "reference"),
        ({"cameras": []}, "0 cameras"),
    ):
        with pytest.raises(ValueError, match=why):
            walk.room(**more)
    walk.models[:] = 0
    with pytest.raises(ValueError, match="perspective"):
        walk.room()


def test_a_ball_has_no_up() -> None:
    ball = np.random.default_rng(2).normal((0.0, 0.0, 9.0), size=(50, 20, 3))
    with pytest.raises(ValueError, match="stands out"):
        to_room(ball, np.eye(3)[None, None].repeat(50, 0), np.zeros((50, 1, 3)), up="auto")


def test_frames_are_said_in_the_room_with_their_cameras(walk: Walk) -> None:
    """By views at rest; by their baselines, where the first view moves and gives the unit."""
    known = walk.room()
    models, scales = walk.models, np.full((80, 3), 200.0)
    models[4, 1], walk.translations[4, 1] = 0, (640, 512, np.nan)  # weak perspective among others
    models[5], models[6, :2] = -1, -1
    lift = {"points3d": walk.points3d, "rotations": walk.rotations, "scales": scales}
    lift |= {"translations": walk.translations, "camera_models": models}
    before = in_cameras(lift)
    for first_moves in (False, True):
        rig = known.rotations.copy(), known.translations.copy()
        if first_moves:
            rig[0][0] = rig[1][0] = np.nan
            units = np.exp(np.random.default_rng(0).normal(0, 0.2, 80))
            lift["points3d"] = walk.points3d * units[:, None, None]
            lift["translations"] = walk.translations.copy()
            deep = models != 0
            lift["translations"][deep] = (walk.translations * units[:, None, None])[deep]
            lift["scales"] = scales / units[:, None]
        # A tenth of the subject's size, in the unit of each frame.
        lift["points3d_sd"] = 0.1 * np.linalg.norm(lift["points3d"].std(1), axis=-1, keepdims=True)
        # Points that are off by a shift along an axis of their own, all by the same.
        axes = (
            np.random.default_rng(1).normal(0, 0.1, (80, 1, 3, 1))
            * lift["points3d_sd"][..., None, None]
        )
        lift["points3d_modes"] = np.repeat(axes, lift["points3d"].shape[1], axis=1)
        squares = lift["points3d_modes"] @ lift["points3d_modes"].mT
        lift["points3d_covariance"] = squares[..., *np.triu_indices(3)]
        placed = in_room(lift, *rig)
        nowhere = [4, 5, 6] if first_moves else [5]  # with one static view there is no baseline
        there = np.delete(np.arange(80), nowhere)
        np.testing.assert_allclose(placed["points3d"][there], walk.truth[there], atol=1e-9)
        sizes = np.linalg.norm(placed["points3d"].std(1), axis=-1, keepdims=True)
        np.testing.assert_allclose(placed["points3d_sd"][there], 0.1 * sizes[there])
        assert np.isnan(placed["points3d_sd"][nowhere]).all()
        moved = in_room(lift | {"points3d": lift["points3d"] + axes[..., 0]}, *rig)
        shifts = (moved["points3d"] - placed["points3d"])[there]
        np.testing.assert_allclose(placed["points3d_modes"][there, ..., 0], shifts, atol=1e-9)
        outer = (shifts[..., None] * shifts[..., None, :])[..., *np.triu_indices(3)]
        np.testing.assert_allclose(placed["points3d_covariance"][there], outer, atol=1e-9)
        assert np.isnan(placed["points3d_modes"][nowhere]).all()
        assert np.isnan(placed["points3d_covariance"][nowhere]).all()
        np.testing.assert_allclose(in_cameras(placed)[there], before[there], rtol=1e-6, atol=1e-6)
        assert np.isnan(placed["points3d"][nowhere]).all()
        assert np.isnan(placed["rotations"][nowhere]).all()
        assert (placed["camera_models"][nowhere] == -1).all()


def in_cameras(lift: dict[str, NDArray[Any]]) -> Float64:
    """Return what (N, K, P, 2) each view's pixel depends on: x / z and y / z, or pixels if weak."""
    turned = np.einsum("nkij,npj->nkpi", lift["rotations"], lift["points3d"])
    shifts, scales = lift["translations"][:, :, None], lift["scales"][..., None, None]
    deep = turned + shifts
    weak = scales * turned[..., :2] + shifts[..., :2]
    models = lift["camera_models"][..., None, None]
    seen = np.where(models == 0, weak, deep[..., :2] / deep[..., 2:])
    return np.where(models < 0, np.nan, seen)


def test_a_real_lift_projects_back_from_the_room() -> None:
    """Ten frames that a fit with cameras at rest answered, one with two views, one with one."""
    lift = load_file(FIXTURES / "resting_lifts.safetensors")
    found = {name[5:]: array for name, array in lift.items() if name.startswith("auto.")}
    room = to_room(
        found["points3d"],
        found["rotations"],
        found["translations"],
        found["camera_models"],
        up=(0, -1, 0),
    )
    assert room.missing == int((found["camera_models"] <= 0).all(1).sum()) < 3
    for view in range(3):
        (fx, fy), (cx, cy) = found["focals"][5, view], found["principal_points"][5, view]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        camera = Camera(
            "v",
            matrix,
            found["distortions"][5, view],
            room.rotations[view],
            room.translations[view],
        )
        errors = np.linalg.norm(camera.project(room.points) - lift["keypoints"][:, view], axis=-1)
        here = found["camera_models"][:, view] > 0
        np.testing.assert_allclose(
            np.nanmean(errors[here], 1), found["reprojection_errors"][here, view], atol=0.02
        )

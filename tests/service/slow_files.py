"""Files that take a while to read, so that a test sees the process that reads them."""

from tests.service.conftest import zip_of

SLOW_FRAMES = 1200


def slow_to_read() -> list[tuple[str, tuple[str, bytes]]]:
    """Return small files of a form whose `SLOW_FRAMES` frames take a while to read."""
    frame = b'{"people": [{"pose_keypoints_2d": [%b]}]}' % b",".join([b"5.5, 7.5, 1"] * 25)
    names = (f"cam_{n:012}_keypoints.json" for n in range(SLOW_FRAMES))
    zipped = zip_of(dict.fromkeys(names, frame))
    return [("files", (f"cam{view}.zip", zipped)) for view in range(2)]

"""SLEAP's analysis H5, of points in 3D: `tracks` (tracks, 3, nodes, frames), of one track.

Scores are confidences of points. Tools for 2D that take the first two axes get x and y.

Source: SLEAP's `sleap.info.write_tracking_h5`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from fewview.animation import Animation
from fewview.writers.confidences import confidences_of


def write(path: Path, animation: Animation) -> None:
    """Write an animation; a missing point is NaN."""
    import h5py  # noqa: PLC0415 (heavy)

    names = animation.names
    sure = confidences_of(animation).T[None]
    seen = np.asarray(animation.seen.any(1))
    edges = np.array(animation.edges, np.int64).reshape(-1, 2)
    joined = [[names[a].encode(), names[b].encode()] for a, b in animation.edges]
    means = np.where(seen, sure[0].sum(0) / np.maximum(animation.seen.sum(1), 1), np.nan)
    arrays: dict[str, Any] = {
        "tracks": animation.points.transpose(2, 1, 0)[None],
        "track_names": np.array([b"subject"]),
        "track_occupancy": seen[:, None].astype(np.uint8),
        "node_names": np.array([name.encode() for name in names]),
        "edge_names": np.array(joined, "S").reshape(-1, 2),
        "edge_inds": edges,
        "point_scores": np.where(animation.seen.T[None], sure, np.nan),
        "instance_scores": means[None],
        "tracking_scores": np.where(seen, 1.0, np.nan)[None],
    }
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values, track_times=False)
        file["labels_path"], file["video_path"], file["video_ind"] = "", "", 0
        file["provenance"] = "{}"

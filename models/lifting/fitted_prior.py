"""A fitted prior: lifts 2D keypoints to structure and cameras, and travels as bytes."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike

from models.calibrating.result import SelfCalibration, camera_report
from models.calibrating.result_files import array_shapes, from_arrays, to_arrays
from models.capture.denoising import ViewModel
from models.capture.observations import as_observations
from models.lifting.curve import CurvePoint, curve_from_tensor, curve_to_tensor
from models.lifting.explanations import Refiner
from models.lifting.frame_refinement import make_refiner, refine_frames
from models.lifting.lift import Lift
from models.network.answers import Answers, make_answers
from models.network.feed_forward import feed_forward
from models.network.priors.registry import lay_out, parameter_shapes
from models.network.settling import SETTLE_ALL
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, pack, read_about, unpack
from models.numerics.threads import in_slices
from models.settings.config import FitConfig, Refine
from models.settings.keypoints import MAX_KEYPOINTS, MIN_KEYPOINTS

DENOISER = "denoiser."  # before those of the model of noisy views
CAMERAS = "cameras."  # before the names of what was found of the cameras, in a file
LIFTED, REFINED = 64, 16  # frames that a thread takes at a time
REFINERS = 64  # choices of views to be prepared for


class FittedPrior:
    """The outcome of a fit. Immutable, and safe to use from several threads at once."""

    def __init__(
        self,
        config: FitConfig,
        arrays: Arrays,
        curve: tuple[CurvePoint, ...],
        foreshortening: float,
        found: SelfCalibration | None = None,
        denoiser: ViewModel | None = None,
    ) -> None:
        self.config = config
        self._denoiser = denoiser
        self.cameras = None if found is None else camera_report(found)
        self._found = found
        self.curve = curve
        self.foreshortening = foreshortening
        self._arrays = arrays
        self._network = lay_out(config, arrays)
        self._refiners: dict[int | tuple[int, ...], Refiner] = {}

    @property
    def noise(self) -> float:
        """Standard deviation of a keypoint's coordinate in pixels; NaN if no cameras were found."""
        return math.nan if self._found is None else self._found.noise

    @property
    def weights(self) -> Arrays:
        """The weights of the network, by name; not to be changed."""
        return self._arrays

    @property
    def keypoints_per_frame(self) -> int:
        """The number of keypoints P that every frame must have."""
        return self._network.keypoints

    def lift(
        self,
        keypoints: ArrayLike,
        *,
        confidence: ArrayLike | None = None,
        refine: Refine | None = None,
        views: Sequence[int] | None = None,
        previous: Lift | None = None,
    ) -> Lift:
        """Lift frames (N, K, P, 2) in pixels, with any number of views K and any gaps.

        Every frame is lifted on its own: neither its neighbours nor the order of the frames
        changes its answer. Structures have the handedness that the fit settled on.

        Parameters
        ----------
        refine
            `off`: the network and weak perspective. `full`: perspective refinement with the lenses,
            the rig and the shapes that the fit found. `auto`: the same, save for frames whose
            keypoints it explains worse than the network. Default: what the fit was told. A fit
            that found no cameras refines nothing.
        views
            Which of the fit's views these are. Default: all of them in their order if K is their
            number, otherwise cameras that the fit does not know.
        previous
            Answers for the frames before, one for each frame and of the same views: where they
            explain a frame's keypoints better than the network's own answer, its refinement starts
            from them, and the lift says so in `continued`. NaN where there is none.

        Raises
        ------
        ValueError
            When the arrays are malformed (see `as_observations`), P differs from the fit's,
            `previous` is of other frames or views, or `views` does not name K different views of
            the fit.
        """
        seen = as_observations(keypoints, confidence)
        frames, count, points_count, _ = seen.keypoints.shape
        if points_count != self.keypoints_per_frame:
            raise ValueError(
                f"this prior was fitted to {self.keypoints_per_frame} keypoints per view,"
                f" got {points_count}; give them in the order of the fit, NaN for what was not"
                " observed"
            )
        if previous is not None and previous.scales.shape != seen.sizes.shape:
            raise ValueError(
                f"previous must have the shape of the keypoints, {frames} frames of {count} views,"
                f" got {previous.scales.shape}"
            )
        fitted = self._views(views, count)
        if self._denoiser is not None and fitted is not None:
            seen = self._denoiser.denoise(seen, fitted)
        mode = self.config.refine if refine is None else refine
        refiner = None if mode == "off" else self._refiner(fitted, count)
        answers = make_answers(frames, count, points_count)
        before = make_answers(0, count, points_count) if previous is None else Answers(*previous)
        policy = SETTLE_ALL if self._found is None else self._found.settling

        def work(part: slice) -> None:
            here = part.start, part.stop
            feed_forward(self._network, seen, self.foreshortening, policy, *here, answers)
            if refiner is not None:
                refine_frames(refiner, seen, before, mode == "full", *here, answers)

        in_slices(frames, LIFTED if refiner is None else REFINED, work)
        return Lift(*answers)

    def _refiner(self, views: Sequence[int] | None, count: int) -> Refiner | None:
        """Return what refines these views, made once for as many choices of views as are usual."""
        if self._found is None:
            return None
        key = count if views is None else tuple(views)
        refiner = self._refiners.get(key)
        if refiner is None:
            if len(self._refiners) >= REFINERS:
                self._refiners.clear()
            refiner = self._refiners[key] = make_refiner(self._found, views, count)
        return refiner

    def _views(self, views: Sequence[int] | None, count: int) -> Sequence[int] | None:
        known = 0 if self._found is None else len(self._found.rig.groups)
        known = known if self._denoiser is None else len(self._denoiser.mean)
        if views is None:
            return range(count) if count == known else None
        if (
            len(views) != count
            or len(set(views)) != count
            or (known and not all(0 <= view < known for view in views))
        ):
            raise ValueError(
                f"views must name {count} different views of the {known or 'unknown'} of the fit,"
                f" got {list(views)}"
            )
        return views if known else None

    def to_bytes(self) -> bytes:
        """Return the prior as safetensors bytes, its configuration in the header."""
        about = {
            "config": self.config.model_dump_json(),
            "keypoints": str(self.keypoints_per_frame),
        }
        cameras: Arrays = {}
        if self._found is not None:
            cameras, about["cameras"] = to_arrays(self._found)
        denoiser: Arrays = {}
        if self._denoiser is not None:
            about["denoiser"] = str(len(self._denoiser.mean))
            denoiser = {
                name: torch.from_numpy(np.array(value, np.float64, ndmin=1, order="C"))
                for name, value in self._denoiser._asdict().items()
            }
        return pack(
            {
                **self._arrays,
                **{f"{CAMERAS}{name}": value for name, value in cameras.items()},
                **{f"{DENOISER}{name}": value for name, value in denoiser.items()},
                "curve": curve_to_tensor(self.curve),
                "foreshortening": torch.tensor([self.foreshortening], dtype=torch.float64),
            },
            kind="prior",
            about=about,
        )

    @classmethod
    def from_bytes(cls, data: bytes) -> "FittedPrior":
        """Read what `to_bytes` wrote.

        Raises
        ------
        WeightsError
            When the bytes are damaged, foreign, or not what their header promises. Nothing larger
            than `data` is allocated before that is known.
        """
        about = read_about(data, kind="prior")
        try:
            config = FitConfig.model_validate_json(about["config"])
            keypoints = int(about["keypoints"])
        except (KeyError, ValueError) as error:
            raise WeightsError("the header holds no valid configuration") from error
        if not MIN_KEYPOINTS <= keypoints <= MAX_KEYPOINTS:
            raise WeightsError(f"the header says {keypoints} keypoints per frame")
        shapes: Shapes = {**parameter_shapes(config, keypoints)}
        cameras = array_shapes(about["cameras"], keypoints, None) if "cameras" in about else {}
        for name, shape in cameras.items():
            shapes[f"{CAMERAS}{name}"] = shape
        if "denoiser" in about:
            shapes[f"{DENOISER}mean"] = (None, keypoints, 2)
            shapes[f"{DENOISER}basis"] = (None, keypoints, 2, None)
            shapes[f"{DENOISER}noise"] = (1,)
        arrays = unpack(data, shapes={**shapes, "curve": (None, 3), "foreshortening": (1,)})
        denoiser = None
        if "denoiser" in about:
            mean, basis, noise = (arrays.pop(f"{DENOISER}{n}") for n in ViewModel._fields)
            denoiser = ViewModel(mean.numpy(), basis.numpy(), noise.item())
            if len(mean) != len(basis) or not denoiser.noise > 0:
                raise WeightsError("the file contradicts itself about the noise")
        found = None
        if cameras:
            parts = {name: arrays.pop(f"{CAMERAS}{name}") for name in cameras}
            found = from_arrays(parts, about["cameras"])
        curve = curve_from_tensor(arrays.pop("curve"))
        return cls(config, arrays, curve, arrays.pop("foreshortening").item(), found, denoiser)

"""The shape of a finding, and its catalogue."""

import numpy as np

from models.findings.catalogue import CATALOGUE, CODES
from models.findings.finding import MOST_RANGES, Finding, frame_ranges, merged


def test_every_code_has_its_consequence_and_what_to_do() -> None:
    assert set(CATALOGUE) == set(CODES)
    for entry in CATALOGUE.values():
        assert entry.effect.endswith(".")
        assert entry.remedy.endswith(".")


def test_frames_become_ranges() -> None:
    assert frame_ranges([]) == ()
    assert frame_ranges([7, 3, 4, 5]) == ((3, 5), (7, 7))
    assert frame_ranges(np.array([False, True, True, False, True])) == ((1, 2), (4, 4))


def test_ranges_are_bounded_and_cover_all_frames() -> None:
    frames = np.cumsum(1 + np.arange(2 * MOST_RANGES) % 7)
    ranges = frame_ranges(frames)
    assert len(ranges) == MOST_RANGES
    assert all(any(a <= frame <= b for a, b in ranges) for frame in frames.tolist())


def test_a_finding_survives_json_and_reads_in_one_line() -> None:
    found = Finding.of("views_swapped", views=[2, 0], frames=[4, 5, 6], share=0.25)
    assert Finding.model_validate_json(found.model_dump_json()) == found
    assert str(found).startswith(
        "warning: views_swapped, views 0 2, frames 4-6, share 0.25. In these frames"
    )


def test_findings_of_parts_are_merged() -> None:
    early = Finding.of("rig_not_used", frames=[2, 3, 9], residual_px=4, noise_px=1)
    late = Finding.of("rig_not_used", frames=[10, 11], residual_px=6, noise_px=1)
    other = Finding.of("frame_unlike_fit", frames=[5], misfit=0.2)
    whole = Finding.of("rig_not_used", frames=[2, 3, 9, 10, 11], residual_px=6, noise_px=1)
    assert merged([early, other, late]) == (whole, other)
    assert merged([late, early]) == (whole,)
    everywhere = [Finding.of("rig_not_used", frames=[3 * n]) for n in range(2 * MOST_RANGES)]
    (joined,) = merged(everywhere)
    assert len(joined.frames) == MOST_RANGES
    assert (joined.frames[0][0], joined.frames[-1][1]) == (0, 6 * MOST_RANGES - 3)

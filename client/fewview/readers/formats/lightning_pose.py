"""Lightning Pose: tables as of DeepLabCut, with a scorer of its own."""

from fewview.readers.formats import deeplabcut
from fewview.readers.separated import table_of
from fewview.readers.sources import Source

SCORERS = ("heatmap", "ensemble", "eks", "lightning")


def fits(source: Source) -> bool:
    """Whether a table has a scorer of Lightning Pose."""
    table = table_of(source) if deeplabcut.fits_csv(source) else None
    if table is None:
        return False
    header = {row[0].lower(): row[1:] for row in table.header}
    scorer = (header.get("scorer") or ("",))[-1].lower()
    return scorer.startswith(SCORERS)

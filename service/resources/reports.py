"""Reports: what a fit may be relied on for, to how much, and what would help most."""

from typing import Annotated, Literal, TypeVar

import numpy as np
from fastapi import APIRouter, Query, Request
from starlette.responses import HTMLResponse, Response
from typing_extensions import TypeAliasType

from models.lifting.fitted_prior import FittedPrior
from service.http.dependencies import StoreDep
from service.http.errors import problems
from service.http.negotiation import accepted_format
from service.http.operations import binary_responses
from service.http.safe_headers import POLICY as POLICY_HEADER
from service.realtime.dependencies import EngineDep
from service.realtime.engine import Engine
from service.report.document import POLICY, document_of
from service.resources.fits import FitDep
from service.wire.cameras import ModelCameras
from service.wire.reports import FitReport, report_on
from store import lookup, records
from store.database import Store
from store.errors import NotFoundError
from store.reports import load_report

router = APIRouter(prefix="/fits", tags=["fits"])

Kept = TypeVar("Kept", records.DatasetRecord, records.ModelRecord)

HTML = "text/html"
ReportFormat = TypeAliasType("ReportFormat", Literal["json", "html"])
FORMATS: dict[str, ReportFormat] = {
    "application/json": "json",
    HTML: "html",
    "*/*": "json",
    "application/*": "json",
    "text/*": "html",
}


@router.get(
    "/{fit_id}/report",
    response_model=FitReport,
    responses=problems("not_found", "conflict", "not_acceptable")
    | binary_responses("The report, as JSON or as a page of HTML.", HTML),
)
def get_report(
    fit: FitDep,
    store: StoreDep,
    engine: EngineDep,
    request: Request,
    format: Annotated[
        ReportFormat | None,
        Query(description="Representation; without it the `Accept` header decides."),
    ] = None,
) -> FitReport | Response:
    """Report what a fit may be relied on for, to how much, and what would help most.

    The expected error of each keypoint, each frame and each choice of views, the noise of the
    detections, the worst frames, and where one more camera would help most; and what the fit knows
    of its cameras. As HTML it is a page that needs nothing else, and may be saved and printed. Fits
    of older versions have none.
    """
    chosen = accepted_format(request, format, FORMATS)
    report = read_report(fit, store, engine)
    if chosen == "json":
        return report
    return HTMLResponse(document_of(report), headers={POLICY_HEADER.decode(): POLICY})


def read_report(fit: records.FitRecord, store: Store, engine: Engine) -> FitReport:
    """Return the report on a fit, with what its dataset and its model know.

    Raises as :func:`store.reports.load_report` does.
    """
    stored = load_report(store, fit)
    dataset = _there(store, records.DatasetRecord, fit.dataset_id)
    model = None if fit.model_id is None else _there(store, records.ModelRecord, fit.model_id)
    skeleton = next((each.skeleton for each in (dataset, model) if each and each.skeleton), {})
    cameras, late = None, None
    if model is not None:
        warm = engine.models.read(store.project, model.id)
        cameras = ModelCameras.of(model.id, warm.prior.cameras, warm.best_frame)
        late = _late(warm.prior)
    return report_on(
        fit,
        stored,
        skeleton=skeleton,
        view_names=None if dataset is None else dataset.view_names,
        cameras=cameras,
        views_late=late,
    )


def _late(prior: FittedPrior) -> list[float] | None:
    """Return by how many seconds each view is late, by the median; None if all are in step."""
    clocks = prior.capture.clocks
    return None if clocks is None else np.median(clocks.offsets, axis=0).tolist()


def _there(store: Store, kind: type[Kept], identifier: str) -> Kept | None:
    """Return a record; None if it was deleted."""
    try:
        return lookup.get(store, kind, identifier)
    except NotFoundError:
        return None

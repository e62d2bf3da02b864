"""Webhooks: URLs that are notified when fits and lifts end."""

from datetime import datetime
from typing import Annotated, Any, Self
from urllib.parse import urlsplit

from fastapi import APIRouter, Query, Response, status
from pydantic import BaseModel, ConfigDict, Field

from service.http.dependencies import Identifier, SettingsDep, StoreDep
from service.http.errors import BODY_PROBLEMS, invalid, problems
from service.http.operations import request_body
from service.http.uploads import UploadBody
from service.resources.lists import LimitQuery, cut
from service.settings import Settings
from service.wire.json_bodies import read_json
from store import records, webhooks
from store.labels import Text
from store.webhooks import EVENTS, WebhookEvent
from worker.addresses import is_public

router = APIRouter(prefix="/webhooks", tags=["webhooks"])

EXAMPLE: dict[str, Any] = {
    "id": "wh_01m7yspdypmt22jq6npfg62xe5",
    "url": "https://lab.example/fewview",
    "events": ["fit.succeeded", "fit.failed"],
    "created_at": "2026-03-01T09:30:00Z",
}
DELIVERED: dict[str, Any] = {
    "id": "msg_01m7yspdypmt22jq6npfg62xe5",
    "event": "fit.succeeded",
    "created_at": "2026-03-01T09:30:00Z",
    "attempts": 1,
    "next_attempt_at": None,
    "delivered_at": "2026-03-01T09:30:01Z",
    "outcome": "The answer was 204.",
}


class WebhookCreate(BaseModel):
    """A webhook to make."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"example": {"url": EXAMPLE["url"], "events": EXAMPLE["events"]}},
    )

    url: Text = Field(
        max_length=2000,
        description="Where to send a POST: `https://` and a host whose addresses are public.",
    )
    events: list[WebhookEvent] = Field(
        list(EVENTS), min_length=1, max_length=len(EVENTS), description="Default: all."
    )


class Webhook(BaseModel):
    """A webhook. Its secret is shown once only, as it is made."""

    model_config = ConfigDict(json_schema_extra={"example": EXAMPLE})

    id: str
    url: str
    events: list[WebhookEvent]
    created_at: datetime

    @classmethod
    def of(cls, record: records.WebhookRecord, **more: str) -> Self:
        """Return the wire form of a record."""
        known = {name: getattr(record, name) for name in ("id", "url", "events", "created_at")}
        return cls.model_validate(known | more)


class NewWebhook(Webhook):
    """A webhook that was made just now, with its secret."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": EXAMPLE | {"secret": "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSwMfKQ9r8GKYo="}
        }
    )

    secret: str = Field(
        description="Signs what is sent, as Standard Webhooks has it. It cannot be had again."
    )


class WebhookPage(BaseModel):
    """Webhooks, newest first."""

    model_config = ConfigDict(json_schema_extra={"example": {"items": [EXAMPLE]}})

    items: list[Webhook]
    next_cursor: str | None = None


class WebhookDelivery(BaseModel):
    """A message to a webhook, and what became of it."""

    model_config = ConfigDict(json_schema_extra={"example": DELIVERED})

    id: str = Field(description="As in `webhook-id`; the same in all attempts.")
    event: WebhookEvent
    created_at: datetime
    attempts: int
    next_attempt_at: datetime | None = Field(description="Null if there will be none.")
    delivered_at: datetime | None
    outcome: str | None = Field(description="Of the last attempt.")

    @classmethod
    def of(cls, record: records.Delivery) -> Self:
        """Return the wire form of a record."""
        known = {name: getattr(record, name) for name in cls.model_fields if hasattr(record, name)}
        return cls.model_validate(known | {"next_attempt_at": record.next_at})


class WebhookDeliveryPage(BaseModel):
    """Messages to a webhook, newest first."""

    model_config = ConfigDict(json_schema_extra={"example": {"items": [DELIVERED]}})

    items: list[WebhookDelivery]
    next_cursor: str | None = None


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses=problems(*BODY_PROBLEMS),
    openapi_extra=request_body(WebhookCreate),
)
def create_webhook(
    upload: UploadBody, store: StoreDep, settings: SettingsDep, response: Response
) -> NewWebhook:
    """Have a URL be notified when fits and lifts of the project end.

    It gets a POST as Standard Webhooks has it: JSON with `type`, `timestamp` and `data` (the job's
    `id`, `status`, `model_id`, `error`), and the headers `webhook-id`, `webhook-timestamp` and
    `webhook-signature`. Any answer but 2xx is a failure, redirections too; further attempts come
    5 s to a day later, nine at most. Nothing is sent once the key that made it is not in force.
    """
    asked = read_json(upload, WebhookCreate)
    _check_url(asked.url, settings)
    record = webhooks.create(store, asked.url, asked.events)
    response.headers["Location"] = f"/webhooks/{record.id}"
    response.headers["Cache-Control"] = "no-store"
    return NewWebhook.of(record, secret=record.secret)


def _check_url(url: str, settings: Settings) -> None:
    """Refuse a URL that nothing would be sent to; names are looked up as messages are sent."""
    anywhere = settings.webhook_private_targets
    schemes = ("https", "http") if anywhere else ("https",)
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError:
        host = None
    if not host or parts.scheme not in schemes or not url.isascii() or not url.isprintable():
        expected = " or ".join(f"{scheme}://" for scheme in schemes)
        raise invalid("/url", f"expected a URL that begins with {expected} and a host; got {url!r}")
    if " " in url or parts.username is not None or parts.fragment:
        raise invalid("/url", "expected a URL without spaces, a user and a fragment")
    try:
        public = is_public(host)
    except ValueError:  # a name
        public = host != "localhost"
    if not public and not anywhere:
        raise invalid("/url", f"expected a host whose addresses are public; got {host!r}")


@router.get("", responses=problems())
def list_webhooks(
    store: StoreDep,
    limit: LimitQuery = 50,
    cursor: Annotated[
        str | None,
        Query(pattern="^wh_[0-9a-z]{26}$", description="`next_cursor` of the page before."),
    ] = None,
) -> WebhookPage:
    """List the webhooks of the project, newest first."""
    page, more = cut(webhooks.page(store, limit=limit + 1, after=cursor), limit)
    return WebhookPage(items=[Webhook.of(record) for record in page], next_cursor=more)


@router.get("/{webhook_id}", responses=problems("not_found"))
def get_webhook(webhook_id: Identifier, store: StoreDep) -> Webhook:
    """Describe a webhook."""
    return Webhook.of(webhooks.get(store, webhook_id))


@router.get("/{webhook_id}/deliveries", responses=problems("not_found"))
def list_webhook_deliveries(
    webhook_id: Identifier,
    store: StoreDep,
    limit: LimitQuery = 50,
    cursor: Annotated[
        str | None,
        Query(pattern="^msg_[0-9a-z]{26}$", description="`next_cursor` of the page before."),
    ] = None,
) -> WebhookDeliveryPage:
    """List what was and is to be sent to a webhook, newest first; what ended stays for a week."""
    page, more = cut(webhooks.deliveries(store, webhook_id, limit=limit + 1, after=cursor), limit)
    items = [WebhookDelivery.of(record) for record in page]
    return WebhookDeliveryPage(items=items, next_cursor=more)


@router.delete(
    "/{webhook_id}", status_code=status.HTTP_204_NO_CONTENT, responses=problems("not_found")
)
def delete_webhook(webhook_id: Identifier, store: StoreDep) -> None:
    """Delete a webhook: nothing is sent to it any more."""
    webhooks.delete(store, webhook_id)

"""Webhooks: URLs that the service notifies when fits and lifts end."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from fewview.api.forms import Page, form_in, page_of
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, Resource, listing, operation
from fewview.api.steps import Request, Steps, nothing, path


@dataclass(frozen=True)
class Webhook:
    """A webhook: its URL, and the events that it gets, such as ``fit.succeeded``."""

    id: str
    url: str
    events: tuple[str, ...]
    created_at: datetime


@dataclass(frozen=True)
class NewWebhook(Webhook):
    """A webhook that was made just now; its ``secret``, which signs, cannot be had again."""

    secret: str = field(repr=False)


@dataclass(frozen=True)
class WebhookDelivery:
    """A message to a webhook; ``outcome`` is that of the last attempt."""

    id: str
    event: str
    created_at: datetime
    attempts: int
    next_attempt_at: datetime | None
    delivered_at: datetime | None
    outcome: str | None


class Webhooks(Resource[Driver]):
    """``/webhooks``; they need the scope ``webhook``."""

    @operation
    def create(self, url: str, events: Iterable[str] | None = None) -> Steps[NewWebhook]:
        """Make a webhook, for all events unless some are given.

        Raises
        ------
        InvalidRequest
            Nothing would be sent to this URL, or there are as many webhooks as may be.
        """
        body: dict[str, Any] = {"url": url}
        if events is not None:
            body["events"] = list(events)
        return self._call(Request("POST", "/webhooks", form_in(NewWebhook), body={"json": body}))

    @operation
    def get(self, webhook: Webhook | str) -> Steps[Webhook]:
        """Describe a webhook; raise ``NotFound`` if there is none."""
        return self._call(Request("GET", path("webhooks", identifier(webhook)), form_in(Webhook)))

    @listing
    def list(self) -> Request[Page[Webhook]]:
        """Iterate over the webhooks of the project, newest first."""
        return Request("GET", "/webhooks", page_of(Webhook))

    @listing
    def deliveries(self, webhook: Webhook | str) -> Request[Page[WebhookDelivery]]:
        """Iterate over the messages to a webhook, newest first."""
        where = path("webhooks", identifier(webhook), "deliveries")
        return Request("GET", where, page_of(WebhookDelivery))

    @operation
    def delete(self, webhook: Webhook | str) -> Steps[None]:
        """Delete a webhook: nothing is sent to it any more."""
        return self._call(Request("DELETE", path("webhooks", identifier(webhook)), nothing))

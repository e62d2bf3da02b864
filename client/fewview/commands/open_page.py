"""``fewview open``: the page, in a browser."""

import webbrowser
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

import typer

from fewview.commands.talking import Url, echo, talking

if TYPE_CHECKING:
    from fewview.client import Client


def open_page(
    *,
    url: Url = None,
    browser: Annotated[
        bool, typer.Option(help="Have a browser open it, rather than print its address alone.")
    ] = True,
) -> None:
    """Open the page of a service, and print its address.

    On the service's own computer the address has a key behind `#`, which lets your browser in until
    the service stops. It is of no use to other users. Elsewhere the page asks for a key.
    """
    with talking(url) as client:
        address = page_address(client)
    echo(address)
    if browser and not webbrowser.open(address):
        echo("fewview open: no browser is found: open the address in one", err=True)


def page_address(client: "Client", screen: str = "") -> str:
    """Return the address of the page, or of a screen of it such as ``/fits/ID``.

    Raises
    ------
    FewviewError
        The service cannot be asked, or lets nobody in without a key.
    """
    from fewview.keys import is_loopback  # noqa: PLC0415 (commands load what they need)

    if not is_loopback(urlsplit(client.url).hostname or ""):
        return f"{client.url}/#{screen}" if screen else client.url
    return f"{client.url}/#key={client.keys.of_page().token}{screen}"

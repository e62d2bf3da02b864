"""What is known of lenses, as people write it: ``26mm``, ``cam1=fov:78,cam2=1460px+-2%``."""

import re
from collections.abc import Sequence
from typing import Any

FORMS = (
    "26mm (equivalent of 35 mm film), fov:78, vfov:50 or dfov:120 (degrees: horizontal, vertical, "
    "diagonal), 1460px, same:cam1; each may end in +-10%"
)
NUMBER = r"(?P<number>[0-9]{1,7}(?:\.[0-9]{1,6})?)"
FIELDS = {
    re.compile(f"{NUMBER}mm"): ("equivalent", None),
    re.compile(f"fov:{NUMBER}"): ("field_of_view", "horizontal"),
    re.compile(f"vfov:{NUMBER}"): ("field_of_view", "vertical"),
    re.compile(f"dfov:{NUMBER}"): ("field_of_view", "diagonal"),
    re.compile(f"{NUMBER}px"): ("focal", None),
}
SAME = "same:"
SLACK = re.compile(rf"(?:\+-|±){NUMBER}%")


def lenses_in(text: str, names: Sequence[str], option: str = "--lens") -> list[Any]:
    """Return ``lenses`` of the configuration of a fit: an entry for each view, or one for all.

    Parameters
    ----------
    text
        One value for all views, or ``VIEW=VALUE`` with commas between; views by name, or by number
        from 0.
    names
        Of the views.

    Raises
    ------
    ValueError
        If it cannot be read, or there is no such view; the message has the forms that can.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) == 1 and "=" not in text:
        return [_lens(parts[0], names, option)]
    lenses: list[Any] = [None] * len(names)
    for part in parts:
        name, equals, value = part.partition("=")
        if not equals:
            raise ValueError(f"{option} {part}: expected VIEW=VALUE, as there are several")
        view = view_in(name.strip(), names, option)
        if lenses[view] is not None:
            raise ValueError(f"{option}: view {name} has two lenses: leave one out")
        lenses[view] = _lens(value.strip(), names, option)
    return lenses


def _lens(text: str, names: Sequence[str], option: str) -> dict[str, Any]:
    if text.startswith(SAME):
        return {"same_as": view_in(text.removeprefix(SAME), names, option)}
    slack = SLACK.search(text)
    value = text[: slack.start()].strip() if slack else text
    for form, (field, axis) in FIELDS.items():
        found = form.fullmatch(value)
        if found and (slack is None or slack.end() == len(text)):
            lens: dict[str, Any] = {field: float(found["number"])}
            if axis is not None:
                lens["axis"] = axis
            if slack:
                lens["sd"] = float(slack["number"]) / 100
            return lens
    raise ValueError(f"{option} {text}: expected one of {FORMS}")


def view_in(name: str, names: Sequence[str], option: str) -> int:
    """Return the index of a view that is given by name, or by number from 0.

    Raises
    ------
    ValueError
        If there is no such view; the message begins with the `option` and lists those there are.
    """
    if name in names:
        return list(names).index(name)
    if name.isdecimal() and int(name) < len(names):
        return int(name)
    raise ValueError(f"{option}: there is no view {name!r}; there are: {', '.join(names)}")

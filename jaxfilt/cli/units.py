"""Units of columns and parameters. Inside everything is in meters, seconds and radians."""

from __future__ import annotations

import math
import re

LENGTH = {
    "m": 1.0, "km": 1000.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "yd": 0.9144, "mi": 1609.344, "nmi": 1852.0,
}  # fmt: skip
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180}
KINDS = {"length": LENGTH, "time": TIME, "angle": ANGLE}

_SPELLINGS = {
    "meters": "m", "metres": "m", "meter": "m", "metre": "m", "feet": "ft", "foot": "ft", "sec": "s", "secs": "s",
    "seconds": "s", "second": "s", "milliseconds": "ms", "minutes": "min", "hours": "h", "degrees": "deg",
    "degree": "deg", "°": "deg", "radians": "rad",
}  # fmt: skip


class BadInput(Exception):
    """The user's file or options cannot be used; the text is one line that says what to do."""


def unit(text: str, kind: str, what: str) -> str:
    """The unit's usual name, or an error that lists the known ones."""
    name = _known(text, kind)
    if name is None:
        raise BadInput(f"{what}: {text!r} is no unit of {kind}; known are {', '.join(KINDS[kind])}")
    return name


def split(header: str) -> tuple[str, str | None]:
    """A header's stem in lower case and the unit in it: ``x [km]``, ``x (km)`` and ``x_km`` give ``("x", "km")``."""
    for pattern in (r"(.*?)[\s_]*[\[(]\s*([^\[\]()]*?)\s*[\])]", r"(.+)_([A-Za-z°]+)"):
        if match := re.fullmatch(pattern, header.strip()):
            stem, text = match.groups()
            for kind in KINDS:
                if name := _known(text, kind):
                    return stem.strip().lower(), name
    return header.strip().lower(), None


def quantity(text: str, kind: str, what: str) -> float:
    """A number with a unit, such as ``5m``, ``0.3 deg`` or ``2``, in SI.

    A kind that is none of :data:`KINDS` is a compound SI unit, which may be left out.
    """
    match = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*:?\s*(\S*)\s*", text)
    if not match:
        raise BadInput(f"{what}: expected a number with a unit, got {text!r}")
    value, suffix = float(match[1]), match[2]
    if kind in KINDS:
        return value * (KINDS[kind][unit(suffix, kind, what)] if suffix else 1.0)
    if suffix not in ("", kind):
        raise BadInput(f"{what}: expected the unit {kind}, got {suffix!r}")
    return value


def _known(text: str, kind: str) -> str | None:
    name = text.strip()
    for candidate in (name, name.lower(), _SPELLINGS.get(name.lower(), "")):
        if candidate in KINDS[kind]:
            return candidate
    return None

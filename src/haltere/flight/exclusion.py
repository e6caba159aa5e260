"""Axes of a sensor that are not to be used for a time: the words of keys ``exclude.gyro`` and ``exclude.accel``. It leaves nothing out."""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from haltere.errors import UsageError

__all__ = ["SPANS", "exclusion_table", "exclusion_text"]

#: Spans that one sensor may have.
SPANS = 4
_SPAN = re.compile(r"([xyz]{1,3})(?:@([0-9.eE+]+)(?:-([0-9.eE+]+))?)?")


def exclusion_table(text: str, where: str = "exclusion") -> NDArray[np.float64]:
    """Spans (`SPANS`, 3) of an exclusion: bits of the axes (x 1, y 2, z 4), start and end [s]; what is not used has no bits.

    Parameters
    ----------
    text
        ``off``, or spans ``AXES[@START[-END]]`` with commas between them, such as ``xyz@20-80`` or ``x@10,yz@30-40``: times of the flight
        [s]; without END to its end, without START all of it.
    where
        Named in the error.

    Raises
    ------
    UsageError
        Something else, or more than `SPANS` spans.
    """
    out = np.zeros((SPANS, 3))
    text = text.strip()
    if text == "off":
        return out
    parts = text.split(",")
    if len(parts) > SPANS:
        raise UsageError(f"at most {SPANS} spans", f"{len(parts)}", where)
    for i, part in enumerate(parts):
        match = _SPAN.fullmatch(part.strip())
        axes = match.group(1) if match else ""
        try:
            start, end = (
                (float(g) if g else d for g, d in zip(match.groups()[1:], (-math.inf, math.inf), strict=True)) if match else (0.0, 0.0)
            )
        except ValueError:
            axes, start, end = "", 0.0, 0.0
        if not axes or len(set(axes)) < len(axes) or not start < end:
            raise UsageError("off, or axes and a time such as xyz@20-80 or x@10,yz@30-40", repr(text), where)
        out[i] = sum(1 << "xyz".index(a) for a in axes), start, end
    return out


def exclusion_text(text: str, where: str = "exclusion") -> str:
    """The same words, checked, without blanks; see `exclusion_table`."""
    exclusion_table(text, where)
    return text.replace(" ", "")

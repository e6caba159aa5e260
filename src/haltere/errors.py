"""The one kind of error a user meets: what was expected, what was found, where, and what to do. It does not print or exit."""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["HaltereError", "UsageError", "nearest"]


class HaltereError(ValueError):
    """Input or a run that cannot be used as it is.

    Parameters
    ----------
    expected, found
        What was needed and what was there instead.
    where
        File, stream, column and row, as far as known.
    remedy
        What the user can do about it.
    """

    exit_status = 1

    def __init__(self, expected: str, found: str, where: str = "", remedy: str = "") -> None:
        self.expected, self.found, self.where, self.remedy = expected, found, where, remedy
        text = f"expected {expected}, found {found}"
        if where:
            text = f"{where}: {text}"
        if remedy:
            text = f"{text}; {remedy}"
        super().__init__(" ".join(text.split()))

    def __reduce__(self) -> tuple[type[HaltereError], tuple[str, str, str, str]]:
        """The same in another process."""
        return type(self), (self.expected, self.found, self.where, self.remedy)


class UsageError(HaltereError):
    """A wrong option, key, name or preset: the command line exits with 2."""

    exit_status = 2


def nearest(name: str, names: Iterable[str]) -> str:
    """``did you mean ...?`` with the nearest of some names, whatever their case; empty where none is near."""
    import difflib

    by_folded = {n.casefold(): n for n in names}
    near = difflib.get_close_matches(name.casefold(), by_folded, 1)
    return f"did you mean {by_folded[near[0]]!r}?" if near else ""

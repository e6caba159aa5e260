"""ArduPilot DataFlash files, binary or text, as columns by message type. It scales as the format says and knows no message's meaning."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.readers._common import FloatArray, IntArray, unusable

__all__ = ["BINARY_HEAD", "DataFlash", "Messages", "is_text_log"]

FMT_TYPE = 0x80
MAGIC = b"\xa3\x95"
#: The first message of a binary log: the format of the format message.
BINARY_HEAD = MAGIC + bytes([FMT_TYPE, FMT_TYPE, 89]) + b"FMT"
TEXT_LINE = re.compile(rb"(?:^|\n)FMT, ?\d+, ?\d+, ?\w+, ?\w+")
#: NumPy type and scale by format letter (the DataFlash format characters of AP_Logger).
LETTERS: dict[str, tuple[str, float | None]] = {
    "a": ("(32,)<i2", None),
    "b": ("i1", None),
    "B": ("u1", None),
    "g": ("<f2", None),
    "h": ("<i2", None),
    "H": ("<u2", None),
    "i": ("<i4", None),
    "I": ("<u4", None),
    "f": ("<f4", None),
    "d": ("<f8", None),
    "n": ("S4", None),
    "N": ("S16", None),
    "Z": ("S64", None),
    "c": ("<i2", 0.01),
    "C": ("<u2", 0.01),
    "e": ("<i4", 0.01),
    "E": ("<u4", 0.01),
    "L": ("<i4", 1e-7),
    "M": ("u1", None),
    "q": ("<i8", None),
    "Q": ("<u8", None),
}
TEXT_LETTERS = "nNZaM"


def is_text_log(head: bytes) -> bool:
    """Whether a file's beginning holds the format lines of a text log."""
    return TEXT_LINE.search(head) is not None


class Messages:
    """All messages of one type.

    Attributes
    ----------
    name
        Message type.
    columns
        Field by name, in the log's own units after the scale of its format letter.
    letters
        Format letter by field.
    place
        Place of each message in the file, ascending.
    """

    def __init__(self, name: str, columns: dict[str, NDArray[Any]], letters: dict[str, str], place: IntArray) -> None:
        self.name, self.columns, self.letters, self.place = name, columns, letters, place

    def __len__(self) -> int:
        return len(self.place)

    def __contains__(self, field: object) -> bool:
        return field in self.columns

    def get(self, *fields: str) -> FloatArray:
        """First of several fields that is there, as float64; NaN where none is, or where it is no number."""
        for field in fields:
            if field in self.columns:
                values = self.columns[field]
                if values.ndim > 1:  # of an array a message, which no number is
                    break
                return np.array(_numbers(self.texts(field)) if values.dtype.kind in "SU" else values, dtype=np.float64)
        return np.full(len(self), np.nan)

    def integers(self, *fields: str) -> IntArray | None:
        """First of several integer fields that is there, or None."""
        for field in fields:
            if field in self.columns:
                values = self.columns[field]
                exact = values.ndim == 1 and values.dtype.kind in "iu"
                whole: IntArray = (values if exact else np.nan_to_num(self.get(field))).astype(np.int64)
                return whole
        return None

    def texts(self, field: str) -> list[str]:
        """A text field."""
        return [v.decode("utf-8", "replace").rstrip("\0") if isinstance(v, bytes) else str(v) for v in self.columns[field].tolist()]

    def where(self, keep: NDArray[Any]) -> Messages:
        """Messages picked by a mask or indices."""
        return Messages(self.name, {k: v[keep] for k, v in self.columns.items()}, self.letters, self.place[keep])

    def own_us(self) -> IntArray | None:
        """The messages' own stamps [us since boot], or None where the type has none.

        Before 2015 ``TimeMS`` of a GPS message is the GPS time of week; the clock is then in ``T``.
        """
        if "TimeUS" in self.columns:
            return self.integers("TimeUS")
        ms: IntArray | None = self.integers("T") if "T" in self.columns and self.name.startswith("GP") else self.integers("TimeMS")
        return None if ms is None else ms * 1000


class DataFlash:
    """A DataFlash file: message types by name.

    Parameters
    ----------
    path
        The ``.bin`` or ``.log`` file.

    Raises
    ------
    HaltereError
        The file cannot be opened or holds no message of a defined format.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.formats: dict[str, tuple[str, list[str], int]] = {}
        self._cache: dict[str, Messages | None] = {}
        self._timed: tuple[IntArray, IntArray] | None = None
        data = path.read_bytes()
        self._data = data
        self._offsets: dict[str, IntArray] = {}
        self._lines: dict[str, tuple[list[list[str]], list[int]]] = {}
        self.binary = BINARY_HEAD in data[:65536]
        if self.binary:
            self._index()
        else:
            self._split()
        if not self._offsets and not self._lines:
            found = "format definitions and nothing after them" if self.formats else "no message"
            raise unusable(path, "a DataFlash log with messages", found)

    def names(self) -> list[str]:
        """Message types with at least one message."""
        return list(self._offsets if self.binary else self._lines)

    def get(self, *names: str) -> Messages | None:
        """Messages of the first type of several that the log has, or None."""
        for name in names:
            if name not in self._cache:
                self._cache[name] = self._decode(name) if self.binary else self._parse(name)
            found = self._cache[name]
            if found is not None and len(found):
                return found
        return None

    def us(self, messages: Messages) -> IntArray:
        """Stamps [us since boot] of messages; types without a clock are stamped by their place between timed messages."""
        own = messages.own_us()
        if own is not None:
            return own
        note = f"{messages.name} has no time of its own: stamped by its place between the timed messages"
        if note not in self.notes:
            self.notes.append(note)
        place, us = self._clock()
        if not len(place):
            return np.empty(0, np.int64)
        return np.rint(np.interp(messages.place, place, us)).astype(np.int64)

    def _clock(self) -> tuple[IntArray, IntArray]:
        if self._timed is None:
            places, stamps = [], []
            for name in self.names():
                messages = self.get(name)
                own = messages.own_us() if messages is not None else None
                if messages is not None and own is not None:
                    places.append(messages.place)
                    stamps.append(own)
            place = np.concatenate([np.empty(0, np.int64), *places])
            us = np.concatenate([np.empty(0, np.int64), *stamps])
            order = np.argsort(place, kind="stable")
            self._timed = place[order], us[order]
        return self._timed

    # Binary

    def _index(self) -> None:
        """Offsets of every message by type, walking from header to header and finding the next one after damage."""
        data, size = self._data, len(self._data)
        lengths = [0] * 256
        lengths[FMT_TYPE] = 89
        found: list[list[int]] = [[] for _ in range(256)]
        names: dict[int, str] = {}
        at, skipped, breaks = 0, 0, 0
        while at + 3 <= size:
            if data[at] == 0xA3 and data[at + 1] == 0x95 and (length := lengths[data[at + 2]]):
                if at + length > size:
                    break
                kind = data[at + 2]
                if kind == FMT_TYPE:
                    name = self._format(data[at + 3 : at + 89], lengths)
                    if name is not None:
                        names[data[at + 3]] = name
                found[kind].append(at)
                at += length
                continue
            after = _next_header(data, at + 1, lengths)
            skipped += after - at
            breaks += 1
            at = after
        if size - at:
            self.notes.append(f"the last {size - at} bytes are not a whole message")
        if skipped:
            self.notes.append(f"{skipped} damaged bytes at {breaks} places were skipped")
        for kind, offsets in enumerate(found):
            if offsets and kind in names:
                places = np.array(offsets, dtype=np.int64)
                earlier = self._offsets.get(names[kind])
                self._offsets[names[kind]] = places if earlier is None else np.sort(np.concatenate([earlier, places]))

    def _format(self, body: bytes, lengths: list[int]) -> str | None:
        """Learn a format message; returns its name."""
        name, letters, fields = (part.split(b"\0")[0].decode("ascii", "replace") for part in (body[2:6], body[6:22], body[22:86]))
        if any(c not in LETTERS for c in letters) or body[1] < 3:
            self.notes.append(f"message type {name!r} left out: format {letters!r} is not understood")
            return None
        if name in self.formats and self.formats[name] != (letters, fields.split(","), body[1]):
            self.notes.append(f"message type {name!r} is defined twice in different ways: the later one is used")
        lengths[body[0]] = body[1]
        self.formats[name] = (letters, fields.split(","), body[1])
        return name

    def _decode(self, name: str) -> Messages | None:
        offsets = self._offsets.get(name)
        if offsets is None:
            return None
        letters, fields, length = self.formats[name]
        dtype = np.dtype([(f"{i}", LETTERS[c][0]) for i, c in enumerate(letters)])
        if dtype.itemsize != length - 3:
            self.notes.append(f"message type {name!r} left out: its format has {dtype.itemsize} bytes, its messages {length - 3}")
            return None
        raw = np.frombuffer(self._data, dtype=np.uint8)
        if not dtype.itemsize:
            return None
        windows = np.lib.stride_tricks.sliding_window_view(raw, dtype.itemsize)
        rows = windows[offsets + 3].view(dtype)[:, 0]
        columns: dict[str, NDArray[Any]] = {}
        for i, (letter, field) in enumerate(zip(letters, fields, strict=False)):
            scale = LETTERS[letter][1]
            columns[field] = rows[f"{i}"] * scale if scale is not None else rows[f"{i}"]
        return Messages(name, columns, dict(zip(fields, letters, strict=False)), offsets)

    # Text

    def _split(self) -> None:
        """Lines of every message by type."""
        short = 0
        for place, line in enumerate(self._data.decode("utf-8", "replace").splitlines()):
            parts = line.split(",")
            name = parts[0].strip()
            if name == "FMT" and len(parts) >= 5:
                letters = parts[4].strip()
                fields = [p.strip() for p in parts[5:]]
                self.formats[parts[3].strip()] = (letters, fields, 0)
                continue
            known = self.formats.get(name)
            if known is None:
                continue
            if len(parts) <= len(known[0]):
                short += 1
                continue
            rows, places = self._lines.setdefault(name, ([], []))
            rows.append(parts[1:])
            places.append(place)
        if short:
            self.notes.append(f"{short} lines with too few fields were skipped")

    def _parse(self, name: str) -> Messages | None:
        found = self._lines.get(name)
        if found is None:
            return None
        rows, places = found
        letters, fields, _ = self.formats[name]
        columns: dict[str, NDArray[Any]] = {}
        for i, (letter, field) in enumerate(zip(letters, fields, strict=False)):
            # The last text field of a line may hold commas itself.
            last = letter in TEXT_LETTERS and i == len(letters) - 1
            cells = [",".join(row[i:]).strip() if last else row[i].strip() for row in rows]
            columns[field] = np.array(cells, dtype=np.str_) if letter in TEXT_LETTERS else _numbers(cells)
        return Messages(name, columns, dict(zip(fields, letters, strict=False)), np.array(places, dtype=np.int64))


def _numbers(cells: list[str]) -> NDArray[Any]:
    """Numbers of text cells: exact integers where all are, NaN where a cell is none."""
    try:
        return np.array([int(c) for c in cells], dtype=np.int64)
    except (ValueError, OverflowError):
        pass
    out = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        try:
            out[i] = float(cell)
        except ValueError:
            continue
    return out


def _next_header(data: bytes, start: int, lengths: list[int]) -> int:
    """Next offset where a message of a known type stands and another header, or the end, follows it."""
    size = len(data)
    at = data.find(MAGIC, start)
    while at >= 0 and at + 3 <= size:
        length = lengths[data[at + 2]]
        end = at + length
        if length and (end >= size or data[end : end + 2] == MAGIC[: size - end]):
            return at
        at = data.find(MAGIC, at + 1)
    return size

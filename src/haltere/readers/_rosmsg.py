"""Encoded ROS 1 and ROS 2 messages to columns, many messages at a time, by their definitions. It knows no type's meaning.

Messages of one type whose strings and sequences have the same lengths have every field at the same place, so the first of them is
walked once and the others are read as rows of one array.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.readers._common import FloatArray
from haltere.readers._rosbag import Channel

__all__ = ["Decoder", "UndecodableError", "definitions"]

#: NumPy codes of ROS's plain types.
CODES = {
    **{"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
#: Elements of an array that are read at most, and steps that the walk of one message takes at most: both far above what is wanted.
ELEMENTS, STEPS = 64, 20_000

#: ROS 2 alone puts this into a type without fields.
FILLER = "structure_needs_at_least_one_member"

#: Field definitions by type name, as rosbags gives them.
Types = Mapping[str, tuple[Any, list[tuple[str, Any]]]]


class UndecodableError(Exception):
    """A message or definition that cannot be understood."""


@lru_cache(maxsize=64)
def definitions(msgtype: str, text: str, language: str, ros1: bool) -> Types:
    """Definitions of a type and all its parts, from a bag's own text, else from the common interfaces that every ROS has.

    Raises
    ------
    UndecodableError
        The text cannot be parsed, or there is none and the type is not common.
    """
    from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

    types: dict[str, Any] = dict(get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY).fielddefs)
    if not language:
        if msgtype not in types:
            raise UndecodableError("the bag does not hold its definition")
        return types
    try:
        if language == "msg":
            own = get_types_from_msg(text, msgtype)
        else:
            # A bag joins the texts of a type's parts with lines "====" and "IDL: name".
            parts = [part.split("\n", 1) for part in text.split("=" * 80 + "\n")]
            texts = [body[1] for body in parts if len(body) == 2 and body[0].startswith("IDL: ")] or [text]
            own = {}
            for one in texts:
                own.update(get_types_from_idl(one))
    except (TypesysError, ValueError, KeyError, IndexError, AssertionError, RecursionError) as error:
        raise UndecodableError(
            f"its definition cannot be parsed ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
        ) from error
    if msgtype not in own:
        raise UndecodableError("the bag's definition is of another type")
    return types | dict(own)


class _Walk:
    """One message walked by its definition: where its wanted fields lie, and the lengths on which that depends."""

    def __init__(self, types: Types, data: bytes, cdr: bool, wanted: frozenset[str]) -> None:
        self.types, self.data, self.wanted = types, data, wanted
        self.base = self.at = 4 if cdr else 0
        self.aligned = cdr
        self.order = "<"
        if cdr:
            if len(data) < 4 or data[0] != 0 or data[1] > 1:
                raise UndecodableError("an encapsulation other than plain CDR")
            self.order = "<" if data[1] else ">"
        self.fields: dict[str, tuple[int, str]] = {}
        self.texts: dict[str, tuple[int, int]] = {}
        self.lengths: list[tuple[int, int]] = []
        self.steps = 0

    def message(self, name: str, path: str = "", plain: str = "", depth: int = 0) -> None:
        """Walk the fields of a type; ``plain`` is the path without the numbers of array elements."""
        if name not in self.types or depth > 32:
            raise UndecodableError(f"no definition of {name}")
        for field, description in self.types[name][1]:
            if field == FILLER and not self.aligned:
                continue
            dot = "." if path else ""
            self.field(description, f"{path}{dot}{field}", f"{plain}{dot}{field}", depth)

    def field(self, description: Any, path: str, plain: str, depth: int) -> None:
        """Walk one field of any kind."""
        kind, value = description
        self.steps += 1
        if self.steps > STEPS:
            raise UndecodableError("too many parts")
        if kind == 1:
            if value[0] == "string":
                n = self.length()
                if plain in self.wanted:
                    self.texts[path] = self.at, n
                self.skip(n)
            else:
                self.plain_values(value[0], 1, path, plain, scalar=True)
        elif kind == 2:
            self.message(value, path, plain, depth + 1)
        else:
            inner, count = value
            count = count if kind == 3 else self.length()
            if inner[0] == 1 and inner[1][0] != "string":
                self.plain_values(inner[1][0], count, path, plain, scalar=False)
                return
            if count > len(self.data):
                raise UndecodableError("a sequence longer than its message")
            for i in range(count):
                self.field(inner, f"{path}[{i}]", plain, depth)

    def plain_values(self, name: str, count: int, path: str, plain: str, *, scalar: bool) -> None:
        """Step over numbers, and remember the wanted ones."""
        code = CODES.get(name)
        if code is None:
            raise UndecodableError(f"a field of type {name}")
        size = int(code[1])
        if count:
            self.align(size)
        whole = plain in self.wanted
        for i in range(min(count, ELEMENTS)):
            if whole or f"{plain}[{i}]" in self.wanted:
                self.fields[path if scalar else f"{path}[{i}]"] = self.at + i * size, self.order + code
        self.skip(count * size)

    def length(self) -> int:
        """The length of a string or sequence, remembered."""
        self.align(4)
        start = self.at
        self.skip(4)
        (n,) = struct.unpack_from(f"{self.order}I", self.data, start)
        self.lengths.append((start, n))
        return int(n)

    def align(self, size: int) -> None:
        """CDR puts a number at a multiple of its size from the end of the encapsulation."""
        if self.aligned:
            self.at += (self.base - self.at) % size

    def skip(self, n: int) -> None:
        """Step on, inside the message."""
        self.at += n
        if self.at > len(self.data):
            raise UndecodableError("a message cut short")


class Decoder:
    """Columns of the wanted fields of one channel's messages.

    Parameters
    ----------
    channel
        Its type and definition.
    wanted
        Names of fields, dotted: ``angular_velocity.x``, ``gyro_rad`` (every element), ``covariance[0]`` (one element of numbers),
        ``esc_status.rpm`` (of every element).

    Raises
    ------
    UndecodableError
        There is no definition, or none that can be understood.
    """

    #: Messages and bytes that are kept before they are turned into columns.
    BATCH, BATCH_BYTES = 8192, 1 << 24

    def __init__(self, channel: Channel, wanted: Iterable[str]) -> None:
        self.channel, self.wanted = channel, frozenset(wanted)
        self.types = definitions(channel.msgtype, channel.definition, channel.language, channel.encoding == "ros1")
        self.bad = 0
        self.why = ""
        self._raw: list[bytes] = []
        self._ns: list[int] = []
        self._bytes = 0
        self._parts: list[tuple[NDArray[np.int64], dict[str, NDArray[Any]]]] = []

    def add(self, ns: int, data: bytes) -> None:
        """Take one message, received at ``ns`` [ns]."""
        self._raw.append(data)
        self._ns.append(min(max(ns, 0), 2**62))
        self._bytes += len(data)
        if len(self._raw) >= self.BATCH or self._bytes > self.BATCH_BYTES:
            self._flush()

    def result(self) -> tuple[NDArray[np.int64], dict[str, FloatArray], dict[str, NDArray[np.str_]]]:
        """Times of reception [ns], columns of numbers (NaN where a message has no such element) and of text."""
        self._flush()
        ns = np.concatenate([part[0] for part in self._parts]) if self._parts else np.empty(0, np.int64)
        numbers: dict[str, FloatArray] = {}
        texts: dict[str, NDArray[np.str_]] = {}
        for name in dict.fromkeys(name for part in self._parts for name in part[1]):
            pieces = [(len(rows), columns.get(name)) for rows, columns in self._parts]
            if any(piece is not None and piece.dtype.kind == "U" for _, piece in pieces):
                texts[name] = np.concatenate([np.full(n, "") if piece is None else piece for n, piece in pieces])
            else:
                numbers[name] = np.concatenate([np.full(n, np.nan) if piece is None else piece for n, piece in pieces])
        return ns, numbers, texts

    def _flush(self) -> None:
        if not self._raw:
            return
        ns = np.array(self._ns, np.int64)
        sizes = np.array([len(raw) for raw in self._raw])
        columns: dict[str, NDArray[Any]] = {}
        good = np.zeros(len(ns), dtype=bool)
        for size in np.unique(sizes):
            rows = np.flatnonzero(sizes == size)
            table = np.frombuffer(b"".join([self._raw[i] for i in rows]), np.uint8).reshape(len(rows), size)
            while len(rows):
                try:
                    walk = _Walk(self.types, self._raw[rows[0]], self.channel.encoding == "cdr", self.wanted)
                    walk.message(self.channel.msgtype)
                except UndecodableError as why:
                    self.bad += 1
                    self.why = str(why)
                    rows, table = rows[1:], table[1:]
                    continue
                same = np.ones(len(rows), dtype=bool)
                if walk.aligned:
                    same &= (table[:, :2] == table[0, :2]).all(axis=1)
                for at, value in walk.lengths:
                    same &= _column(table, at, f"{walk.order}u4") == value
                mine = table if same.all() else table[same]
                self._take(walk, mine, rows[same], columns, len(ns))
                good[rows[same]] = True
                rows, table = rows[~same], table[~same]
        self._parts.append((ns[good], {name: values[good] for name, values in columns.items()}))
        self._raw, self._ns, self._bytes = [], [], 0

    def _take(self, walk: _Walk, table: NDArray[np.uint8], rows: NDArray[np.intp], columns: dict[str, NDArray[Any]], n: int) -> None:
        for name, (at, code) in walk.fields.items():
            columns.setdefault(name, np.full(n, np.nan))[rows] = _column(table, at, code)
        for name, (at, length) in walk.texts.items():
            texts = [bytes(row).split(b"\0", 1)[0].decode("utf-8", "replace") for row in table[:, at : at + length]]
            new = np.array(texts, dtype=np.str_)
            old = columns.get(name, np.full(n, ""))
            wide = old.astype(np.promote_types(old.dtype, new.dtype))
            wide[rows] = new
            columns[name] = wide


def _column(table: NDArray[np.uint8], at: int, code: str) -> NDArray[Any]:
    """One number of every row."""
    return np.ascontiguousarray(table[:, at : at + int(code[2])]).view(code)[:, 0]

"""One session of a blackbox file as columns, parsed by orangebox: damage is stepped over and counted. It knows no field's meaning."""

from __future__ import annotations

import logging
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from haltere.errors import HaltereError
from haltere.readers._common import Builder, FloatArray, IntArray, unusable

__all__ = ["MAGIC", "Session"]

#: Every session begins with this line.
MAGIC = b"H Product:Blackbox flight data recorder"
#: Whole frames that may be refused one after another before their clock is believed.
DOUBT = 50
#: No logger pauses longer [us].
LONGEST_PAUSE = 3600e6
#: First byte of a frame.
FRAME_TYPE = re.compile(rb"[IPSGHE]")
#: Errors in a row, without a frame between them, after which a file is given up.
HOPELESS = 10_000


class Session:
    """The longest session of a blackbox file.

    Parameters
    ----------
    path
        The file.
    builder
        Takes the notes and counts.

    Attributes
    ----------
    headers
        Header lines as orangebox reads them.
    us
        Time of every frame [us], ascending.
    names
        Fields.

    Raises
    ------
    HaltereError
        orangebox is not installed, or the header cannot be parsed.
    """

    def __init__(self, path: Path, builder: Builder) -> None:
        try:
            import orangebox
        except ImportError:
            raise HaltereError(
                "the package orangebox, which parses blackbox logs",
                "it is not installed",
                str(path),
                'pip install "haltere[blackbox]"',
            ) from None
        data = _longest(path.read_bytes(), builder)
        with _quiet(), tempfile.TemporaryDirectory(prefix="haltere-") as folder:
            # orangebox reads files only, and takes what stands before the first session for a header.
            file = Path(folder) / "session.bbl"
            file.write_bytes(data)
            try:
                parser = orangebox.Parser.load(str(file), allow_invalid_header=True)
                names = list(parser.field_names)
                at = names.index("loopIteration"), names.index("time")
            except Exception as error:
                raise unusable(path, "a blackbox header that can be parsed", f"{type(error).__name__}: {error}") from error
            self.headers: dict[str, Any] = dict(parser.headers)
            rows = _Frames(parser, *at, self.headers)
            table = list(rows)
        self.names = names
        if bad := {len(row) for row in table} - {len(names)}:
            raise unusable(path, f"frames of {len(names)} fields, as many as the header names", " or ".join(map(str, sorted(bad))))
        missing = _missing([row[at[0]] for row in table])
        builder.discard("imu", "frames damaged, not to be decoded, or never written", max(missing, rows.damaged))
        if rows.cut:
            builder.note("the log ends without its end mark: the recording was cut short, or power was")
        columns = [np.array([], dtype=np.float64)] * len(names) if not table else [_numbers(c) for c in zip(*table, strict=True)]
        self._columns: dict[str, FloatArray] = dict(zip(names, columns, strict=True))
        empty = sum(int(np.isnan(c).sum()) for c in columns)
        if empty:
            late = sum(bool(np.isnan(c).any()) for c in columns)
            builder.note(f"{empty} cells of {late} slow fields hold nothing yet: NaN")
        self.us: IntArray = np.array([row[at[1]] for row in table], dtype=np.int64)

    def __contains__(self, field: object) -> bool:
        return field in self._columns

    def has(self, field: str) -> bool:
        """Whether a field is there and holds numbers."""
        return field in self._columns and bool(np.isfinite(self._columns[field]).any())

    def all_of(self, stem: str, count: int) -> bool:
        """Whether ``stem[0]`` ... ``stem[count - 1]`` are all there."""
        return all(self.has(f"{stem}[{i}]") for i in range(count))

    def get(self, field: str) -> FloatArray:
        """A field as logged; NaN where it is missing."""
        return self._columns.get(field, np.full(len(self.us), np.nan))


def _longest(data: bytes, builder: Builder) -> bytes:
    """The longest session of a file by size; the others are told."""
    starts: list[int] = []
    at = data.find(MAGIC)
    while at >= 0:
        starts.append(at)
        at = data.find(MAGIC, at + len(MAGIC))
    sizes = np.diff([*starts, len(data)])
    longest = int(np.argmax(sizes))
    if len(starts) > 1:
        total = 100.0 * float(sizes[longest]) / float(sizes.sum())
        builder.note(
            f"the file holds {len(starts)} sessions (one an arming): this is number {longest + 1}, the longest, "
            f"{total:.0f} % of the bytes; split the file to read the others"
        )
    if starts[0]:
        builder.note(f"{starts[0]} bytes before the first session were skipped")
    return data[starts[longest] : starts[longest] + int(sizes[longest])]


class _Frames:
    """Whole frames of a parser, resynchronised at the next complete one after damage."""

    def __init__(self, parser: Any, iteration: int, time: int, headers: dict[str, Any]) -> None:
        self.parser = parser
        self.key = itemgetter(iteration, time)
        step = headers.get("looptime"), headers.get("pid_process_denom", 1)
        #: Microseconds an iteration, where the header tells.
        self.step = float(step[0] * step[1]) if all(isinstance(s, int) and s > 0 for s in step) else None
        interval = headers.get("I interval")
        self.interval = interval if isinstance(interval, int) and interval > 0 else 1
        self.damaged = 0
        self.cut = False
        self.last: tuple[int, int] | None = None

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        synced, refused, errors, lost = False, 0, 0, 0
        reader = self.parser.reader
        while True:
            before = reader.tell()
            try:
                for frame in self.parser.frames():
                    # A frame that orangebox dropped is missing in the sums of those after it, up to the next complete one.
                    dropped = self._dropped()
                    if dropped != lost:
                        lost, synced = dropped, False
                    complete = frame.type.value == "I"
                    if complete:
                        synced = self._believable(frame.data) or refused >= DOUBT
                    if not synced or not self._forward(frame.data, refused):
                        self.damaged += 1
                        refused += 1
                        synced = synced and not complete
                        continue
                    refused, errors = 0, 0
                    self.last = self.key(frame.data)
                    yield frame.data
                return
            except Exception:
                # Past the end, or bytes that no decoder takes: orangebox stops where it stands.
                synced = False
                errors += 1
                if reader.tell() >= len(reader) or errors > HOPELESS:
                    self.cut = not any(e.type.name == "LOG_END" for e in self.parser.events)
                    return
                self.damaged += 1
                reader.seek(self._next_type(max(reader.tell(), before + 1)))

    def _next_type(self, at: int) -> int:
        """Where the next byte stands that a frame could begin with.

        Started anew on another one, orangebox would go back to the first frame, and read all the log again after every damaged place.
        """
        found = FRAME_TYPE.search(self.parser.reader._frame_data, at)
        return found.start() if found else len(self.parser.reader)

    def _dropped(self) -> int:
        return int(self.parser._ctx.invalid_frame_count)

    def _forward(self, data: tuple[Any, ...], refused: int) -> bool:
        if self.last is None or refused >= DOUBT:
            return True
        return bool(0 < self.key(data)[1] - self.last[1] < LONGEST_PAUSE)

    def _believable(self, data: tuple[Any, ...]) -> bool:
        """Whether a complete frame fits in with the one before: random bytes seldom do."""
        iteration, time = self.key(data)
        if iteration % self.interval:
            return False
        if self.last is None or self.step is None:
            return True
        elapsed, expected = time - self.last[1], (iteration - self.last[0]) * self.step
        return bool(iteration > self.last[0] and abs(elapsed - expected) <= 0.5 * expected + 1e5)


def _missing(iterations: list[int]) -> int:
    """Frames that are missing between whole ones, by the usual step of the loop counter."""
    if len(iterations) < 3:
        return 0
    steps = np.diff(np.array(iterations, dtype=np.float64))
    usual = float(np.median(steps))
    return int(np.sum(np.maximum(np.rint(steps / usual) - 1.0, 0.0))) if usual > 0.0 else 0


def _numbers(cells: tuple[Any, ...]) -> FloatArray:
    """A column as float64; orangebox fills fields that were not yet sent with empty text."""
    try:
        return np.array(cells, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        return np.array([float(c) if isinstance(c, int | float) else np.nan for c in cells])


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep orangebox's remarks off standard error: what matters is counted here."""
    log = logging.getLogger("orangebox")
    before = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(before)

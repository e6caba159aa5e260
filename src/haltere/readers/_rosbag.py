"""ROS 1 bags, ROS 2 bags and MCAP files as raw messages in the order of the file, up to where it is whole. It decodes no message."""

from __future__ import annotations

import bz2
import contextlib
import re
import shutil
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from haltere.readers._common import Builder, unusable

__all__ = ["BAG_MAGIC", "DB3_MAGIC", "MCAP_MAGIC", "ZSTD_MAGIC", "Channel", "messages", "storages"]

BAG_MAGIC = b"#ROSBAG V"
MCAP_MAGIC = b"\x89MCAP0\r\n"
DB3_MAGIC = b"SQLite format 3\0"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
#: No record or chunk of a whole file is longer [bytes]; a length beyond it is damage and is not allocated.
RECORD_LIMIT = 1 << 31
#: Kinds of record: ROS 1 bag format 2.0, and MCAP.
BAG_MESSAGE, BAG_HEADER, BAG_CHUNK, BAG_CONNECTION = b"\x02", b"\x03", b"\x05", b"\x07"
MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE, MCAP_CHUNK = 3, 4, 5, 6

#: A ROS message's type in both spellings: package/Type and package/msg/Type.
BARE_TYPE = re.compile(r"^([^/]+)/([^/]+)$")


class Channel(NamedTuple):
    """One topic of one sender: name, type (``package/msg/Type``), its definition and the definition's language (``msg``, ``idl`` or none).

    ``encoding`` is ``ros1``, ``cdr`` (ROS 2) or another that is not read.
    """

    topic: str
    msgtype: str
    definition: str
    language: str
    encoding: str


#: Whether a channel's messages are wanted. It is asked once a channel, and so learns of all of them.
Wanted = Callable[[Channel], bool]
Messages = Iterator[tuple[Channel, int, bytes]]


class DamageError(Exception):
    """A record that is cut short or makes no sense; what came before it stands."""


def storages(path: Path, builder: Builder) -> list[Path]:
    """Files of a bag in order: the file itself, or those of a ROS 2 bag folder.

    Parameters
    ----------
    path
        A bag, or a folder with ``metadata.yaml``, ``.db3`` or ``.mcap`` files.
    builder
        Told of files that are missing.

    Raises
    ------
    HaltereError
        A folder without a single bag file.
    """
    if not path.is_dir():
        return [path]
    there = {p.name: p for p in path.iterdir() if p.is_file() and re.search(r"\.(db3|mcap)(\.zstd)?$", p.name)}
    listed: list[str] = []
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        text = metadata.read_text(encoding="utf-8", errors="replace")
        # Both "- NAME" (relative_file_paths) and "- path: NAME" (files).
        names = re.findall(r"^\s*-\s*(?:path:\s*)?['\"]?(\S.*?\.(?:db3|mcap)(?:\.zstd)?)['\"]?\s*$", text, re.MULTILINE)
        listed = list(dict.fromkeys(Path(name).name for name in names))
        for name in listed:
            if name not in there:
                builder.note(f"{name} is named in metadata.yaml and is not there: its messages are missing")
    chosen = [there[name] for name in listed if name in there]
    if not chosen:
        kinds = [[p for p in there.values() if kind in p.suffixes] for kind in (".mcap", ".db3")]
        chosen = sorted(next((k for k in kinds if k), []), key=lambda p: [int(s) if s.isdigit() else s for s in re.split(r"(\d+)", p.name)])
        if chosen:
            builder.note(f"no metadata.yaml that names its files: read {', '.join(p.name for p in chosen)}")
    if not chosen:
        raise unusable(path, "a ROS 2 bag with .db3 or .mcap files", "none of them in the folder", "copy the whole bag folder")
    return chosen


def messages(path: Path, wanted: Wanted, builder: Builder) -> Messages:
    """Messages of one bag file.

    Parameters
    ----------
    path
        A ``.bag``, ``.mcap`` or ``.db3`` file, the latter two perhaps compressed whole as ``.zstd``.
    wanted
        Which channels to read.
    builder
        Told of damage.

    Yields
    ------
    tuple
        Channel, time of reception [ns] and the encoded message.

    Raises
    ------
    HaltereError
        The file is of a version or kind that cannot be read at all.
    """
    with contextlib.ExitStack() as stack:
        file: BinaryIO = stack.enter_context(path.open("rb"))
        head = file.read(len(DB3_MAGIC))
        file.seek(0)
        if head.startswith(ZSTD_MAGIC):
            path = _unpacked(path, file, stack, builder)
            file = stack.enter_context(path.open("rb"))
            head = file.read(len(DB3_MAGIC))
            file.seek(0)
        if head.startswith(BAG_MAGIC):
            source = _bag(path, file, wanted)
        elif head.startswith(MCAP_MAGIC):
            source = _mcap(file, wanted)
        elif head.startswith(DB3_MAGIC):
            source = _db3(path, wanted, builder, stack)
        else:
            raise unusable(path, "a ROS bag, MCAP or db3 file", f"one that begins with {head[:8]!r}")
        try:
            for channel, ns, data in source:
                # A ROS 2 message begins with its encapsulation, 0 and 0 or 1, so a compressed one is known by its own magic.
                packed = channel.encoding == "cdr" and data.startswith(ZSTD_MAGIC)
                yield channel, ns, _zstd(data, RECORD_LIMIT) if packed else data
        except DamageError as damage:
            builder.note(f"{path.name} is damaged or was not closed ({damage}): read up to there")


# Compression


def _zstd_module() -> Any:
    try:
        from compression import zstd  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        from backports import zstd
    return zstd


def _zstd(data: bytes, limit: int) -> bytes:
    """Unpack one or as much as there is of a cut zstd frame."""
    zstd = _zstd_module()
    try:
        return bytes(zstd.ZstdDecompressor().decompress(data, limit))
    except (zstd.ZstdError, EOFError) as error:
        raise DamageError(f"zstd data: {error}") from error


def _unpack(kind: str, data: bytes, limit: int) -> bytes:
    """A chunk's records; of a cut chunk those that are there."""
    if kind in ("", "none"):
        return data
    if kind == "zstd":
        return _zstd(data, limit)
    try:
        if kind == "bz2":
            return bz2.BZ2Decompressor().decompress(data, limit)
        if kind == "lz4":
            import lz4.frame  # type: ignore[import-untyped]

            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, limit))
    except (OSError, RuntimeError, EOFError, ValueError) as error:
        raise DamageError(f"{kind} data: {error}") from error
    raise DamageError(f"compression {kind!r}, which is not known")


def _unpacked(path: Path, file: BinaryIO, stack: contextlib.ExitStack, builder: Builder) -> Path:
    """A file compressed whole, unpacked into a temporary one that goes when the stack does."""
    zstd = _zstd_module()
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    target = folder / path.name.removesuffix(".zstd")
    with target.open("wb") as out:
        try:
            with zstd.open(file, "rb") as packed:
                shutil.copyfileobj(packed, out, 1 << 20)
        except (zstd.ZstdError, EOFError) as error:
            builder.note(f"{path.name} is damaged or cut short ({error}): read up to there")
    return target


# Records


class _Cursor:
    """Fields of a record one after another; running over its end is damage."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, n: int) -> bytes:
        if n < 0 or self.at + n > len(self.data):
            raise DamageError("a field runs over the end of its record")
        self.at += n
        return self.data[self.at - n : self.at]

    def number(self, code: str) -> int:
        return int(struct.unpack(f"<{code}", self.take(struct.calcsize(f"<{code}")))[0])

    def text(self) -> str:
        return self.take(self.number("I")).decode("utf-8", "replace")


def _exactly(file: BinaryIO, n: int, size: int, what: str) -> bytes:
    """The next n bytes of a file of a known size."""
    at = file.tell()
    if n > RECORD_LIMIT or at + n > size:
        raise DamageError(f"{what} at byte {at} runs over the end of the file")
    return file.read(n)


def _size(file: BinaryIO) -> int:
    at = file.tell()
    size = file.seek(0, 2)
    file.seek(at)
    return size


def _typename(name: str) -> str:
    return BARE_TYPE.sub(r"\1/msg/\2", name)


# ROS 1 bags


def _fields(data: bytes) -> dict[bytes, bytes]:
    """Fields ``name=value`` of a ROS 1 record header."""
    out: dict[bytes, bytes] = {}
    at = 0
    while at < len(data):
        if at + 4 > len(data):
            raise DamageError("a record header is cut")
        (n,) = struct.unpack_from("<I", data, at)
        name, mark, value = data[at + 4 : at + 4 + n].partition(b"=")
        if not mark or at + 4 + n > len(data):
            raise DamageError("a record header makes no sense")
        out[name] = value
        at += 4 + n
    return out


def _field(fields: dict[bytes, bytes], name: bytes, code: str) -> int:
    value = fields.get(name, b"")
    if len(value) != struct.calcsize(f"<{code}"):
        raise DamageError(f"a record header has no {name.decode()}")
    return int(struct.unpack(f"<{code}", value)[0])


class _BagScan:
    """Records of a ROS 1 bag, inside and outside of chunks."""

    def __init__(self, wanted: Wanted) -> None:
        self.wanted = wanted
        self.channels: dict[int, Channel | None] = {}
        self.unknown: set[int] = set()

    def record(self, header: bytes, data: bytes) -> tuple[Channel, int, bytes] | None:
        fields = _fields(header)
        kind = fields.get(b"op")
        if kind == BAG_MESSAGE:
            connection = _field(fields, b"conn", "I")
            channel = self.channels.get(connection)
            if channel is None:
                if connection not in self.channels:
                    self.unknown.add(connection)
                return None
            stamp = _field(fields, b"time", "Q")
            return channel, (stamp & 0xFFFFFFFF) * 1_000_000_000 + (stamp >> 32), data
        if kind == BAG_CONNECTION:
            self._connection(fields, data)
        return None

    def _connection(self, fields: dict[bytes, bytes], data: bytes) -> None:
        connection = _field(fields, b"conn", "I")
        if connection in self.channels:
            return
        inner = {k: v.decode("utf-8", "replace") for k, v in _fields(data).items()}
        topic = fields.get(b"topic", b"").decode("utf-8", "replace")
        channel = Channel(topic, _typename(inner.get(b"type", "")), inner.get(b"message_definition", ""), "msg", "ros1")
        self.channels[connection] = channel if self.wanted(channel) else None

    def chunk(self, data: bytes) -> Messages:
        at, end = 0, len(data)
        while at < end:
            if at + 4 > end:
                raise DamageError("a chunk is cut")
            (n,) = struct.unpack_from("<I", data, at)
            if at + 8 + n > end:
                raise DamageError("a chunk is cut")
            header = data[at + 4 : at + 4 + n]
            (m,) = struct.unpack_from("<I", data, at + 4 + n)
            at += 8 + n
            if at + m > end:
                raise DamageError("a message is cut")
            found = self.record(header, data[at : at + m])
            at += m
            if found is not None:
                yield found


def _bag(path: Path, file: BinaryIO, wanted: Wanted) -> Messages:
    """Messages of a ROS 1 bag. The index at its end is not needed, so a bag that was not closed can be read."""
    line = file.readline(32)
    if line.strip() != b"#ROSBAG V2.0":
        raise unusable(path, "a ROS 1 bag of version 2.0", repr(line[:16]), "bring it up to date: `rosbag fix OLD.bag NEW.bag`")
    size = _size(file)
    scan = _BagScan(wanted)
    spoilt: DamageError | None = None
    while (at := file.tell()) < size:
        header = _exactly(file, struct.unpack("<I", _exactly(file, 4, size, "a record"))[0], size, "a record header")
        (n,) = struct.unpack("<I", _exactly(file, 4, size, "a record"))
        fields = _fields(header)
        if fields.get(b"op") == BAG_CHUNK:
            # The chunk that was open when recording stopped has length 0: its records follow as if they stood alone.
            left = size - file.tell()
            if min(n, left) > RECORD_LIMIT:
                raise DamageError(f"a chunk at byte {at} is {n} bytes long")
            data = file.read(min(n, left))
            kind = fields.get(b"compression", b"none").decode("ascii", "replace")
            try:
                yield from scan.chunk(_unpack(kind, data, min(_field(fields, b"size", "I"), RECORD_LIMIT) or RECORD_LIMIT))
            except DamageError as damage:
                spoilt = DamageError(f"chunk at byte {at}: {damage}")
            if n > left:
                raise spoilt or DamageError(f"chunk at byte {at}: cut")
        elif fields.get(b"op") == BAG_HEADER and fields.get(b"encryptor"):
            raise unusable(path, "a plain bag", "an encrypted one", "decrypt it: `rosbag decrypt`")
        else:
            found = scan.record(header, _exactly(file, n, size, "a record"))
            if found is not None:
                yield found
    if spoilt is not None:
        raise spoilt
    if scan.unknown:
        raise DamageError(f"messages of {len(scan.unknown)} connections that are described nowhere before them")


# MCAP


class _McapScan:
    """Records of an MCAP file, inside and outside of chunks."""

    def __init__(self, wanted: Wanted) -> None:
        self.wanted = wanted
        self.schemas: dict[int, tuple[str, str, str]] = {}
        self.channels: dict[int, Channel | None] = {}

    def record(self, kind: int, data: bytes) -> tuple[Channel, int, bytes] | None:
        if kind == MCAP_MESSAGE:
            if len(data) < 22:
                raise DamageError("a message is cut")
            number, _, ns = struct.unpack_from("<HIQ", data)
            channel = self.channels.get(number)
            return (channel, ns, data[22:]) if channel is not None else None
        if kind == MCAP_SCHEMA:
            at = _Cursor(data)
            number, name, language = at.number("H"), at.text(), at.text()
            self.schemas[number] = name, language, at.text()
        elif kind == MCAP_CHANNEL:
            at = _Cursor(data)
            number, schema, topic, encoding = at.number("H"), at.number("H"), at.text(), at.text()
            if number not in self.channels:
                name, language, text = self.schemas.get(schema, ("", "", ""))
                known = {"ros1msg": "msg", "ros2msg": "msg", "ros2idl": "idl"}.get(language, "")
                channel = Channel(topic, _typename(name), text if known else "", known, encoding)
                self.channels[number] = channel if self.wanted(channel) else None
        return None

    def chunk(self, data: bytes) -> Messages:
        at, end = 0, len(data)
        while at < end:
            if at + 9 > end:
                raise DamageError("a chunk is cut")
            kind, n = struct.unpack_from("<BQ", data, at)
            at += 9
            if at + n > end:
                raise DamageError("a record of a chunk is cut")
            found = self.record(kind, data[at : at + n])
            at += n
            if found is not None:
                yield found


def _mcap(file: BinaryIO, wanted: Wanted) -> Messages:
    """Messages of an MCAP file. The summary at its end is not needed, so a file that was not closed can be read."""
    file.seek(len(MCAP_MAGIC))
    size = _size(file)
    scan = _McapScan(wanted)
    spoilt: DamageError | None = None
    while (at := file.tell()) < size:
        if size - at == len(MCAP_MAGIC) and file.read(len(MCAP_MAGIC)) == MCAP_MAGIC:
            break
        file.seek(at)
        kind, n = struct.unpack("<BQ", _exactly(file, 9, size, "a record"))
        left = size - file.tell()
        if n > left and (kind != MCAP_CHUNK or left > RECORD_LIMIT):
            raise DamageError(f"a record at byte {at} runs over the end of the file")
        if kind not in (MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE, MCAP_CHUNK):
            file.seek(n, 1)
            continue
        if n > RECORD_LIMIT and n <= left:
            raise DamageError(f"a record at byte {at} is {n} bytes long")
        data = file.read(min(n, left))
        if kind != MCAP_CHUNK:
            found = scan.record(kind, data)
            if found is not None:
                yield found
            continue
        try:
            head = _Cursor(data)
            head.take(16)
            unpacked_size, checksum = head.number("Q"), head.number("I")
            compression = head.text()
            head.take(8)
            records = _unpack(compression, data[head.at :], min(unpacked_size, RECORD_LIMIT) or RECORD_LIMIT)
            # 0: none was written. A chunk that is cut has its first records, which cannot be checked.
            if checksum and n <= left and zlib.crc32(records) != checksum:
                raise DamageError("its checksum is wrong, left out")
            yield from scan.chunk(records)
        except DamageError as damage:
            spoilt = DamageError(f"chunk at byte {at}: {damage}")
        if n > left:
            raise spoilt or DamageError(f"chunk at byte {at}: cut")
    else:
        raise spoilt or DamageError("its end is missing")
    if spoilt is not None:
        raise spoilt


# ROS 2 db3


def _database(path: Path, builder: Builder, stack: contextlib.ExitStack) -> sqlite3.Connection:
    """The file opened for reading alone, with the messages of the write-ahead log that a recorder left if it was stopped hard."""
    mode = "mode=ro&immutable=1"
    wal = path.with_name(path.name + "-wal")
    if wal.is_file() and wal.stat().st_size:
        # SQLite would leave a file beside the log, so it works on a copy.
        try:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            for part in (path, wal):
                shutil.copyfile(part, folder / part.name)
            path, mode = folder / path.name, "mode=rw"
        except OSError as error:
            builder.note(f"{wal.name} could not be read ({error.strerror or error}): its messages are missing")
    database = stack.enter_context(contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)))
    database.text_factory = lambda raw: raw.decode("utf-8", "replace")
    return database


def _db3(path: Path, wanted: Wanted, builder: Builder, stack: contextlib.ExitStack) -> Messages:
    """Messages of a ROS 2 SQLite file in the order of recording. The index by time is not needed."""
    database = _database(path, builder, stack)
    try:
        tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise unusable(path, "a ROS 2 bag with the tables topics and messages", f"the tables {', '.join(sorted(tables)) or 'none'}")
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            rows = database.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
            definitions = {name: (text, {"ros2msg": "msg", "ros2idl": "idl"}.get(language, "")) for name, language, text in rows}
        channels: dict[int, Channel] = {}
        for number, topic, msgtype, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id"):
            text, language = definitions.get(str(msgtype), ("", ""))
            channel = Channel(str(topic), _typename(str(msgtype)), str(text) if language else "", language, str(encoding))
            if wanted(channel):
                channels[number] = channel
        marks = ", ".join("?" * len(channels))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})"
        for number, ns, data in database.execute(query, list(channels)):
            if isinstance(ns, int) and isinstance(data, bytes):
                yield channels[number], ns, data
    except (sqlite3.Error, OverflowError, UnicodeError) as error:  # a damaged name in an error text is no UTF-8
        raise DamageError(str(error)) from error

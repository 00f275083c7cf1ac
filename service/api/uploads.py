"""Uploads: multipart/form-data streamed to the data folder, refused as early as possible."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from pydantic import TypeAdapter, ValidationError
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from sprung.model.text import CONTROL, UNSEEN
from sprung.replay.recording import EXTENSIONS
from sprung.service.api.bodies import VehicleId
from sprung.service.api.problems import ApiProblem, from_validation
from sprung.service.api.scopes import FORM
from sprung.service.core import Core
from sprung.service.durable import sync_folder
from sprung.service.settings import Settings
from sprung.service.store import Store, work
from sprung.service.store.work import RecordingRow
from sprung.service.times import AHEAD, from_iso, now_ns
from sprung.service.upload_room import Share

CHUNK = 1 << 20
DECEIVING = re.compile(f"[{CONTROL}{UNSEEN}]")  # characters that a name should not have
MOST_PARTS = 8
FIELDS = ("vehicle", "start")  # beside the file
MOST_FIELD_BYTES = 4096
LONGEST_BOUNDARY = 70  # RFC 2046
_VEHICLE: TypeAdapter[str] = TypeAdapter(VehicleId)

BODY: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "additionalProperties": False,
                "required": ["file"],
                "properties": {
                    "file": {"type": "string", "format": "binary", "description": "its name says its kind"},
                    "vehicle": {"type": "string", "description": "whose it is; else as recorded, else the file's name"},
                    "start": {
                        "type": "string",
                        "description": "when it began (RFC 3339, or seconds since the epoch) where its times count "
                        "from 0; else it is taken to begin when it was received",
                    },
                },
            }
        }
    },
}


@dataclass(frozen=True, slots=True)
class Upload:
    """A file that was received whole, with what the form says of it: its vehicle, and in the row when it began."""

    row: RecordingRow
    vehicle: str | None
    identity: str  # of a form: the file's content and name, the vehicle and the start
    fresh: bool = True  # False: it was sent before and is still kept; the row is that one's


@asynccontextmanager
async def receive(request: Request, core: Core) -> AsyncIterator[Upload]:
    """Receive the form of a request; the file is kept unless its handling fails.

    Raises ApiProblem: 415 for another type of body or of file, 413 when it is too large, 422 for a wrong form; NoSpace.
    Nothing stays on the disk then.
    """
    boundary = _boundary(request)
    stated = request.headers.get("content-length", "")
    share = core.upload_room.share()
    try:
        await run_in_threadpool(share.take, int(stated) if stated.isdigit() else 0)
        upload = await _read(request, Form(core.settings, boundary, share))
        upload = await run_in_threadpool(_once, core.settings, core.store, upload)
        try:
            yield upload
        except BaseException:
            _discard(core.settings, upload)
            raise
    finally:
        share.give_back()  # not before the store counts what was accepted


async def identity_of(request: Request, settings: Settings) -> str:
    """What `receive` would give as the upload's identity; nothing is kept.  Raises ApiProblem as it does."""
    form = Form(settings, _boundary(request), None)
    return (await _read(request, form)).identity


def _boundary(request: Request) -> bytes:
    kind, options = parse_options_header(request.headers.get("content-type", ""))
    boundary = options.get(b"boundary")
    if kind != FORM.encode() or not boundary:
        raise ApiProblem(415, "send multipart/form-data with a file")
    if len(boundary) > LONGEST_BOUNDARY:
        raise ApiProblem(422, f"the boundary of the form is longer than {LONGEST_BOUNDARY} characters")
    return boundary


async def _read(request: Request, form: Form) -> Upload:
    try:
        held = bytearray()
        async for chunk in request.stream():
            held += chunk
            if len(held) >= CHUNK or form.size == 0:
                await run_in_threadpool(form.feed, bytes(held))
                held.clear()
        await run_in_threadpool(form.feed, bytes(held))
        return await run_in_threadpool(form.finish)
    except FormParserError as error:
        raise ApiProblem(422, f"the body is no multipart/form-data: {error}") from error
    finally:
        form.close()


@dataclass
class _Part:
    """One part of the form while it comes."""

    headers: dict[bytes, bytes] = field(default_factory=dict)
    name: str = ""
    is_file: bool = False
    value: bytearray = field(default_factory=bytearray)


class Form:
    """Takes the bytes of a form; the file goes to the disk as it comes, unless it is only looked at (share: None)."""

    def __init__(self, settings: Settings, boundary: bytes, share: Share | None) -> None:
        self.size = 0  # of the file so far
        self._uploads = settings.uploads
        self._share = share
        self._came = 0  # bytes of the form so far, with those that are being looked at
        self._parts = 0
        self._part = _Part()
        self._header = (bytearray(), bytearray())
        self._values: dict[str, bytearray] = {}
        self._label: str | None = None
        self._extension = ""
        self._digest = hashlib.sha256()  # of the file so far
        self._part_file = ""
        self._id = work.new_id()
        self._target: BinaryIO | None = None
        self._ended = False
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._begin_part,
                "on_header_begin": lambda: self._set_header(bytearray(), bytearray()),
                "on_header_field": lambda data, start, end: self._header[0].extend(data[start:end]),
                "on_header_value": lambda data, start, end: self._header[1].extend(data[start:end]),
                "on_header_end": self._end_header,
                "on_headers_finished": self._begin_content,
                "on_part_data": self._content,
                "on_end": self._end,
            },
        )

    def feed(self, data: bytes) -> None:
        """The next bytes.  Raises ApiProblem or NoSpace as soon as they are wrong."""
        if data:
            self._came += len(data)
            self._parser.write(data)

    def finish(self) -> Upload:
        """The file in its place, on the disk for good."""
        self._parser.finalize()
        if self._target is None or self._label is None:
            raise ApiProblem(422, "file is missing", [{"field": "file", "detail": "is missing"}])
        if not self._ended:
            raise ApiProblem(422, "the body ends within the form")
        vehicle, began = self._vehicle(), self._start()
        digest = self._digest.hexdigest()
        stored = work.upload_name(digest, self._id, self._extension)
        if self._share is not None:
            self._target.flush()
            os.fsync(self._target.fileno())
            self._target.close()
            (self._uploads / self._part_file).replace(self._uploads / stored)
            sync_folder(self._uploads)
        row = RecordingRow(self._id, None, self._label, "upload", stored, self.size, None, now_ns(), None, began)
        return Upload(row, vehicle, json.dumps([digest, self._label, vehicle, began]))

    def close(self) -> None:
        """Delete an unfinished upload."""
        if self._target is not None and not self._target.closed:
            self._target.close()
        if self._part_file:
            (self._uploads / self._part_file).unlink(missing_ok=True)

    def _vehicle(self) -> str | None:
        """Whose it is, as the form says."""
        if "vehicle" not in self._values:
            return None
        try:
            return _VEHICLE.validate_python(self._values["vehicle"].decode("utf-8", "replace"))
        except ValidationError as error:
            raise from_validation(error, "vehicle.") from None

    def _start(self) -> int | None:
        """When the recording began, ns since 1970, as the form says."""
        text = self._values.get("start", bytearray()).decode("utf-8", "replace")
        if not text:
            return None
        try:
            began = from_iso(text)
        except (ValueError, OverflowError):
            raise _wrong_start("is no time such as 2026-09-21T14:13:20Z") from None
        if not 0 <= began <= now_ns() + AHEAD:
            raise _wrong_start("is before 1970 or in the future")
        return began

    def _begin_part(self) -> None:
        self._parts += 1
        if self._parts > MOST_PARTS:
            raise ApiProblem(422, f"the form has more than {MOST_PARTS} parts")
        self._part = _Part()

    def _set_header(self, name: bytearray, value: bytearray) -> None:
        self._header = (name, value)

    def _end_header(self) -> None:
        name, value = self._header
        self._part.headers[bytes(name).lower()] = bytes(value)

    def _begin_content(self) -> None:
        _, options = parse_options_header(self._part.headers.get(b"content-disposition", b""))
        self._part.name = options.get(b"name", b"").decode("utf-8", "replace")
        self._part.is_file = b"filename" in options
        if not self._part.is_file:
            self._begin_value(self._part.name)
            return
        if self._part.name != "file" or self._target is not None:
            raise ApiProblem(422, "give one file, in the field `file`", [{"field": "file", "detail": "one is needed"}])
        name = options[b"filename"].decode("utf-8", "replace")
        self._label = DECEIVING.sub("_", name.replace("\\", "/").rsplit("/", 1)[-1][-255:])
        self._extension = known_extension(self._label)
        if self._share is not None:
            self._part_file = f"{self._id}.part"
            self._target = open(self._uploads / self._part_file, "xb")  # noqa: SIM115 (closed by `close`)
        else:
            self._target = open(os.devnull, "wb")  # noqa: SIM115 (closed by `close`)

    def _begin_value(self, name: str) -> None:
        """A part that is no file: one of the form's fields, once."""
        if name == "file":
            raise ApiProblem(
                422, "file comes without its name (`filename`)", [{"field": "file", "detail": "has no name"}]
            )
        if name not in FIELDS:
            detail = f"is no field of the form; it has file, {', '.join(FIELDS)}"
            raise ApiProblem(422, f"{name[:40]!r} {detail}", [{"field": name[:40], "detail": detail}])
        if name in self._values:
            raise ApiProblem(422, f"the form gives {name} twice", [{"field": name, "detail": "is given twice"}])
        self._values[name] = bytearray()

    def _content(self, data: bytes, start: int, end: int) -> None:
        if self._part.is_file:
            assert self._target is not None
            self.size += end - start
            if self._share is not None:
                self._share.reach(self._came)
            self._target.write(memoryview(data)[start:end])
            if self._share is not None:
                self._share.written = self.size
            self._digest.update(memoryview(data)[start:end])
            return
        value = self._values[self._part.name]
        value += data[start:end]
        if len(value) > MOST_FIELD_BYTES:
            raise ApiProblem(422, f"the form's field {self._part.name[:40]!r} is too long")

    def _end(self) -> None:
        self._ended = True


def _wrong_start(detail: str) -> ApiProblem:
    return ApiProblem(422, f"start {detail}", [{"field": "start", "detail": detail}])


def known_extension(label: str) -> str:
    """The extension of a file's name; a 415 ApiProblem where no reader knows it."""
    extension = Path(label).suffix.lower()
    if extension not in EXTENSIONS:
        detail = f"has no known extension; known are {' '.join(EXTENSIONS)}"
        raise ApiProblem(415, f"file {detail}", [{"field": "file", "detail": detail}], {"Connection": "close"})
    return extension


def _discard(settings: Settings, upload: Upload) -> None:
    """Delete an upload that was received and could not be accepted after all."""
    if upload.fresh and upload.row.file is not None:
        (settings.uploads / upload.row.file).unlink(missing_ok=True)


def _once(settings: Settings, store: Store, upload: Upload) -> Upload:
    """The same upload; where it was sent before and is still kept, that one, and the new file goes."""
    with store.read() as connection:
        before = work.same_upload(connection, upload.row, upload.vehicle)
    if before is None or before.file is None or not (settings.uploads / before.file).is_file():
        return upload
    _discard(settings, upload)
    return replace(upload, row=before, fresh=False)

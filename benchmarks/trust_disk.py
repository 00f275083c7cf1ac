"""A disk that forgets what was not synced, made from the system calls that strace saw.

What is modelled: a file's bytes last when it was synced after they were written; of younger writes any may be there or
not, whole or torn at a sector.  Names last when the folder was synced, or, for a new file, when the file itself was;
of younger creations, renames and removals the first few may have happened, in their order, as journals of file systems
keep them.  Not modelled: disks that confirm a sync and do not keep it, and reordering inside a sector.
"""

from __future__ import annotations

import random
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

SECTOR = 512
CALL = re.compile(r"^(\d+) +(\w+)\((.*)$", re.S)
DESCRIPTOR = re.compile(r"(-?\d+|AT_FDCWD)<([^>]*)>")
TEXT = re.compile(r'"((?:\\x[0-9a-f]{2})*)"(\.\.\.)?')
RESULT = re.compile(r"\) += (-?\d+)(?:<([^>]*)>)?")
TRACED = (
    "openat,creat,write,pwrite64,writev,pwritev,fsync,fdatasync,ftruncate,rename,renameat,renameat2,unlink,unlinkat,"
    "mkdir,mkdirat,rmdir,sendto,sendmsg,lseek"
)
NAMING = frozenset({"openat", "creat", "rename", "renameat", "renameat2", "unlink", "unlinkat"}) | {
    "mkdir",
    "mkdirat",
    "rmdir",
}


@dataclass(frozen=True, slots=True)
class SystemCall:
    """One that succeeded, on a file below the traced folder or on a socket."""

    name: str  # write, sync, truncate, create, rename, remove, folder, send
    path: str
    offset: int = 0
    data: bytes = b""
    other: str = ""  # the new name of a rename


def system_calls(lines: Iterable[str], root: str) -> Iterator[SystemCall]:
    """What a log of `strace -f -y -xx -s 10000000` says of the files below `root`, in its order."""
    unfinished: dict[str, str] = {}
    places: dict[str, int] = {}  # where `write` goes on, by path: files are written through one descriptor
    for line in lines:
        process = line.split(" ", 1)[0]
        if "<unfinished ...>" in line:
            unfinished[process] = line[: line.index("<unfinished ...>")].rstrip("\n")
            continue
        resumed = line.find("resumed>")
        whole = line if resumed < 0 else unfinished.pop(process, "") + line[resumed + len("resumed>") :]
        found, result = CALL.match(whole), RESULT.search(whole)
        if found is None or result is None or int(result[1]) < 0:
            continue
        name, rest = found[2], found[3]
        texts = [_bytes(match[1]) for match in TEXT.finditer(rest)]
        if name in NAMING:
            call = _naming(name, rest, texts, root, places)
        else:
            call = _moving(name, rest, texts, root, places, int(result[1]))
        if call is not None:
            yield call


def _naming(name: str, rest: str, texts: list[bytes], root: str, places: dict[str, int]) -> SystemCall | None:
    """Calls that make, rename and remove."""
    folders = _folders(rest)
    paths = [_below(path.decode(errors="replace"), folders, number) for number, path in enumerate(texts)]
    if not paths or not paths[0].startswith(root):
        return None
    if name.startswith("rename"):
        return SystemCall("rename", paths[0], other=paths[1])
    if name.startswith("mkdir"):
        return SystemCall("folder", paths[0])
    if name in ("unlink", "unlinkat", "rmdir"):
        return SystemCall("remove", paths[0])
    places[paths[0]] = 0
    if "O_CREAT" not in rest and name != "creat":
        return None
    return SystemCall("create", paths[0], offset=int("O_TRUNC" in rest or name == "creat"))


def _moving(
    name: str, rest: str, texts: list[bytes], root: str, places: dict[str, int], result: int
) -> SystemCall | None:
    """Calls that write, truncate, sync and send."""
    where = DESCRIPTOR.match(rest)
    held = _plain(where[2]) if where else ""
    data = b"".join(texts)
    if name.startswith("send"):
        return SystemCall("send", held, data=data) if data else None
    if not held.startswith(root):
        return None
    if name in ("fsync", "fdatasync"):
        return SystemCall("sync", held)
    if name == "ftruncate":
        return SystemCall("truncate", held, offset=int(rest.split(",")[1].split(")", maxsplit=1)[0]))
    if name == "lseek":
        places[held] = result
        return None
    if name in ("pwrite64", "pwritev"):
        return SystemCall("write", held, int(re.findall(r", (\d+) *\) +=", rest)[-1]), data[:result])
    offset = places.get(held, 0)
    places[held] = offset + result
    return SystemCall("write", held, offset, data[:result])


def _folders(rest: str) -> list[str]:
    return [_plain(match[2]) for match in DESCRIPTOR.finditer(TEXT.sub('""', rest.split(") = ", maxsplit=1)[0]))]


def _below(path: str, folders: list[str], number: int) -> str:
    if path.startswith("/") or not folders:
        return path
    return f"{folders[min(number, len(folders) - 1)]}/{path}"


def _plain(text: str) -> str:
    return _bytes(text).decode(errors="replace") if text.startswith("\\x") else text


def _bytes(text: str) -> bytes:
    return bytes.fromhex(text.replace("\\x", ""))


@dataclass(slots=True)
class _File:
    kept: bytearray = field(default_factory=bytearray)
    young: list[SystemCall] = field(default_factory=list)  # writes and truncations since the last sync
    named: bool = False  # its name lasts


class ForgetfulDisk:
    """Takes calls in their order; `after_a_cut` is what a machine finds when it is switched on again."""

    def __init__(self, root: str) -> None:
        self._root = root
        self._now: dict[str, _File] = {}  # as processes see it
        self._kept: dict[str, _File] = {}  # names that last
        self._names: list[SystemCall] = []  # creations, renames and removals that do not last yet
        self._new: dict[int, _File] = {}  # the file of a creation that does not last yet, by the identity of the call

    def hold(self, folder: Path) -> None:
        """Begin with the files of a folder, which last; it stands for the root."""
        for path in folder.rglob("*"):
            if path.is_file():
                name = f"{self._root}/{path.relative_to(folder).as_posix()}"
                self._now[name] = self._kept[name] = _File(bytearray(path.read_bytes()), named=True)

    def take(self, call: SystemCall) -> None:
        """One further call."""
        match call.name:
            case "create":
                file = self._now.get(call.path)
                if file is None:
                    file = self._now[call.path] = _File()
                    self._names.append(call)
                    self._new[id(call)] = file
                elif call.offset:
                    file.young.append(SystemCall("truncate", call.path))
            case "write" | "truncate":
                if call.path in self._now:
                    self._now[call.path].young.append(call)
            case "rename":
                self._names.append(call)
                _rename(self._now, call)
            case "remove":
                self._names.append(call)
                self._now.pop(call.path, None)
            case "sync":
                self._sync(call.path)

    def _sync(self, path: str) -> None:
        file = self._now.get(path)
        if file is not None:
            for call in file.young:
                _apply(file.kept, call)
            file.young.clear()
            if not file.named:  # a new file: everything that was done to names before it lasts with it
                last = max((n for n, call in enumerate(self._names) if self._new.get(id(call)) is file), default=-1)
                self._settle(self._kept, self._names[: last + 1])
                self._names = self._names[last + 1 :]
                file.named = True
        else:  # a folder
            self._settle(self._kept, self._names)
            self._names = []

    def _settle(self, names: dict[str, _File], calls: list[SystemCall]) -> None:
        for call in calls:
            if call.name == "create":
                names[call.path] = self._new[id(call)]
            elif call.name == "rename":
                _rename(names, call)
            else:
                names.pop(call.path, None)

    def after_a_cut(self, rng: random.Random) -> dict[str, bytes]:
        """Contents by name: all that lasts, and by chance some of what does not."""
        names = dict(self._kept)
        self._settle(names, self._names[: rng.choice((0, len(self._names), rng.randint(0, len(self._names))))])
        found = {}
        for path, file in names.items():
            content = bytearray(file.kept)
            share = rng.choice((0.0, 1.0, rng.random()))
            for call in file.young:
                if rng.random() < share:
                    _apply(content, _torn(call, rng) if rng.random() < 0.2 else call)
            found[path] = bytes(content)
        return found

    def write(self, found: dict[str, bytes], target: Path) -> None:
        """Put what a cut left into a folder."""
        for path, content in found.items():
            place = target / path.removeprefix(self._root).lstrip("/")
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content)


def _rename(names: dict[str, _File], call: SystemCall) -> None:
    """Of a file, or of a folder with all that is in it."""
    for path in [path for path in names if path == call.path or path.startswith(call.path + "/")]:
        names[call.other + path.removeprefix(call.path)] = names.pop(path)


def _apply(content: bytearray, call: SystemCall) -> None:
    if call.name == "truncate":
        del content[call.offset :]
        content.extend(bytes(max(0, call.offset - len(content))))
        return
    content.extend(bytes(max(0, call.offset - len(content))))
    content[call.offset : call.offset + len(call.data)] = call.data


def _torn(call: SystemCall, rng: random.Random) -> SystemCall:
    if call.name != "write":
        return call
    kept = rng.randrange(0, len(call.data) + 1, SECTOR)
    return SystemCall("write", call.path, call.offset, call.data[:kept])

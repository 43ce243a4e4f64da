# SPDX-License-Identifier: Apache-2.0
"""What a power cut may leave of files, from what their writer really asked the system for.

A `Recorder` notes every operation on the files of one folder. `crash_state` then plays a crash:
of what was not synced, any part may be there or not. The rules are those that POSIX leaves to a
file system and that ext4 and xfs make use of:

* data of a file is certain once `fsync` of it has returned; before that each write may be there,
  missing, cut at any byte, or there as zeros (the length is out, the blocks are not), whatever
  became of the writes before and after it;
* names (create, rename, remove, of files and folders) are certain once `fsync` of their folder
  has returned; before that the first n of a folder's changes are there, for any n, whatever
  became of any data;
* a rename is there or not, never half.
"""

from __future__ import annotations

import os
import random
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Operation:
    """One thing the writer did; `file` is a number, as a name may change its file.

    `size` is where a write begins, or what a truncation leaves.
    """

    kind: str
    folder: str = ''
    name: str = ''
    file: int = -1
    data: bytes = b''
    size: int = 0


@dataclass
class Recorder:
    """Note what is done below `root` while `recording`; marks are what the writer promised."""

    root: Path
    operations: list[Operation] = field(default_factory=list)
    marks: list[tuple[int, object]] = field(default_factory=list)

    def __post_init__(self):
        self._files: dict[str, int] = {}
        self._open: dict[int, int] = {}
        self._folders: dict[int, str] = {}
        self._sizes: dict[int, int] = {}
        self._count = 0
        # What is there already is certain.
        for path in sorted(self.root.rglob('*')):
            place = self._place(path)
            if path.is_dir():
                self._log('mkdir', *place)
            else:
                data = path.read_bytes()
                file = self._new_file(place)
                self._sizes[file] = len(data)
                self._log('write', file=file, data=data)
                self._log('sync', file=file)
            self._log('sync folder', place[0])

    def mark(self, what):
        """Note that `what` was acknowledged to the caller: from now on it must survive."""
        self.marks.append((len(self.operations), what))

    def _place(self, path):
        relative = os.path.relpath(path, self.root)
        return None if relative.startswith('..') else os.path.split(relative)

    def _log(self, kind, folder='', name='', **values):
        self.operations.append(Operation(kind, folder, name, **values))

    def _new_file(self, place):
        self._count += 1
        self._files[os.path.join(*place)] = self._count
        self._sizes[self._count] = 0
        self._log('link', *place, file=self._count)
        return self._count

    @contextmanager
    def recording(self):
        """Stand between the writer and the system."""
        real = {
            name: getattr(os, name)
            for name in ('open', 'write', 'fsync', 'ftruncate', 'close', 'replace', 'rename',
                         'unlink', 'mkdir', 'rmdir')
        }  # fmt: skip

        def open_(path, flags, *args, **kwargs):
            place = self._place(path)
            fresh = place is not None and not os.path.lexists(path)
            descriptor = real['open'](path, flags, *args, **kwargs)
            if place is None:
                return descriptor
            if flags & os.O_DIRECTORY:
                self._folders[descriptor] = os.path.normpath(os.path.join(*place))
                return descriptor
            if fresh:
                self._new_file(place)
            file = self._open[descriptor] = self._files[os.path.join(*place)]
            if flags & os.O_TRUNC and not fresh:
                self._sizes[file] = 0
                self._log('truncate', file=file)
            return descriptor

        def write(descriptor, data):
            written = real['write'](descriptor, data)
            if descriptor in self._open:
                file = self._open[descriptor]
                self._log('write', file=file, data=bytes(data[:written]), size=self._sizes[file])
                self._sizes[file] += written
            return written

        def fsync(descriptor):
            real['fsync'](descriptor)
            if descriptor in self._folders:
                self._log('sync folder', self._folders[descriptor])
            elif descriptor in self._open:
                self._log('sync', file=self._open[descriptor])

        def ftruncate(descriptor, size):
            real['ftruncate'](descriptor, size)
            if descriptor in self._open:
                self._sizes[self._open[descriptor]] = size
                self._log('truncate', file=self._open[descriptor], size=size)

        def close(descriptor):
            self._open.pop(descriptor, None)
            self._folders.pop(descriptor, None)
            real['close'](descriptor)

        def replace(source, target, **kwargs):
            real['replace'](source, target, **kwargs)
            a, b = self._place(source), self._place(target)
            assert a[0] == b[0], 'renamed across folders'
            file = self._files.pop(os.path.join(*a))
            self._files[os.path.join(*b)] = file
            self._log('rename', a[0], a[1] + '\0' + b[1], file=file)

        def unlink(path, **kwargs):
            real['unlink'](path, **kwargs)
            place = self._place(path)
            if place is not None:
                self._files.pop(os.path.join(*place))
                self._log('unlink', *place)

        def mkdir(path, *args, **kwargs):
            real['mkdir'](path, *args, **kwargs)
            place = self._place(path)
            if place is not None:
                self._log('mkdir', *place)

        def rmdir(path, **kwargs):
            real['rmdir'](path, **kwargs)
            place = self._place(path)
            if place is not None:
                self._log('rmdir', *place)

        ours = dict(open=open_, write=write, fsync=fsync, ftruncate=ftruncate, close=close,
                    replace=replace, rename=replace, unlink=unlink, mkdir=mkdir,
                    rmdir=rmdir)  # fmt: skip
        for name, function in ours.items():
            setattr(os, name, function)
        try:
            yield self
        finally:
            for name, function in real.items():
                setattr(os, name, function)


def crash_state(operations, chooser: random.Random) -> dict[str, bytes | None]:
    """Return one state that a crash after these operations may leave: path -> content.

    Folders are paths with None. The chooser decides what becomes of everything not synced.
    """
    names: dict[str, list[Operation]] = {}
    certain: dict[str, int] = {}
    changes: dict[int, list[Operation]] = {}
    synced: dict[int, int] = {}
    for operation in operations:
        if operation.kind in ('link', 'rename', 'unlink', 'mkdir', 'rmdir'):
            names.setdefault(_normal(operation.folder), []).append(operation)
        elif operation.kind == 'sync folder':
            folder = _normal(operation.folder)
            certain[folder] = len(names.get(folder, ()))
        elif operation.kind == 'sync':
            synced[operation.file] = len(changes.get(operation.file, ()))
        else:
            changes.setdefault(operation.file, []).append(operation)
    contents = {
        file: _content(changes.get(file, []), synced.get(file, 0), chooser)
        for file in {op.file for op in operations if op.file >= 0}
    }
    state: dict[str, bytes | None] = {}
    _walk('', names, certain, contents, chooser, state)
    return state


def _walk(folder, names, certain, contents, chooser, state):
    """Put what the folder holds into `state`: its first n changes of names, with n by chance."""
    done = names.get(folder, [])
    entries: dict[str, int | None] = {}
    for operation in done[: chooser.randint(certain.get(folder, 0), len(done))]:
        if operation.kind == 'link':
            entries[operation.name] = operation.file
        elif operation.kind == 'mkdir':
            entries[operation.name] = None
        elif operation.kind == 'rename':
            source, target = operation.name.split('\0')
            entries[target] = entries.pop(source)
        else:
            del entries[operation.name]
    for name, file in entries.items():
        path = os.path.join(folder, name)
        if file is None:
            state[path] = None
            _walk(path, names, certain, contents, chooser, state)
        else:
            state[path] = contents[file]


def _content(changes, synced, chooser):
    """Return a file's content: certain up to the sync, beyond it each change by chance."""
    data = bytearray()
    for number, change in enumerate(changes):
        fate = chooser.choice(('kept', 'kept', 'lost', 'cut', 'zeros', 'holes'))
        if number < synced:
            fate = 'kept'
        if change.kind == 'truncate':
            if fate in ('kept', 'cut', 'holes'):
                del data[change.size :]
            continue
        piece = change.data
        if fate == 'lost':
            continue
        if fate == 'cut':
            piece = piece[: chooser.randint(0, len(piece))]
        elif fate == 'zeros':
            piece = piece[: chooser.randint(0, len(piece))].ljust(len(piece), b'\0')
        elif fate == 'holes':
            begin, end = sorted(chooser.randint(0, len(piece)) for _ in range(2))
            piece = piece[:begin] + bytes(end - begin) + piece[end:]
        # What was lost before it is a hole.
        data.extend(bytes(max(0, change.size - len(data))))
        data[change.size : change.size + len(piece)] = piece
    return bytes(data)


def _normal(folder):
    return '' if folder == '.' else folder


def materialise(state, folder: Path):
    """Make the files of a crash state below a folder."""
    for path, data in state.items():
        if data is None:
            (folder / path).mkdir(parents=True, exist_ok=True)
        else:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(data)

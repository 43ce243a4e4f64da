# SPDX-License-Identifier: Apache-2.0
"""OptiTrack Motive's export of a take: rigid bodies and markers, a line for each frame.

Above the frames are a line about the take and a line each for type, name, ID, in newer versions
the parent, the quantity and the axis; they are recognised by words, not by their number.
"""

from __future__ import annotations

import csv
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.importing.makers.named import NamedColumns, unexpected
from remaster_ros.importing.units import LENGTHS
from remaster_ros.types import BoolArray, FloatArray, IntArray

_UNITS = {
    **dict.fromkeys(('millimeters', 'millimetres', 'mm'), 'mm'),
    **dict.fromkeys(('centimeters', 'centimetres', 'cm'), 'cm'),
    **dict.fromkeys(('meters', 'metres', 'm'), 'm'),
    **dict.fromkeys(('inches', 'in'), 'in'),
}
_START = re.compile(r'\s*"?Format Version"?([,;\t])')
_KIND_NAMES = ('Rigid Body', 'Rigid Body Marker', 'Marker', 'Bone', 'Bone Marker', 'Skeleton')
# A take that was written without its first line.
_HEADLESS = re.compile(
    rf'[ \r\n]*([,;\t])"?(?:Type)?"?\1+"?(?:{"|".join(_KIND_NAMES)})"?(?:\1|\r?\n)', re.ASCII
)
_NUMBER = re.compile(r'[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?', re.ASCII)
_MOST_HEAD_LINES = 12
# A marker whose extent is less than this share of the largest one is not on the arm.
_STATIC = 0.02
# Smallest distance of two markers, m. A piece of a track that begins later than this after the
# previous one, s, may belong to any marker.
_SAME_M, _LOST_S = 0.01, 0.5
# Kinds of assets on a tool, the likeliest first: the points of a body share one solution.
_KINDS = ('Rigid Body', 'Marker', 'Rigid Body Marker')


def _likeliness(kind: str) -> int:
    """Rank of a kind of asset, such as ``Marker``, 0 for the likeliest; 3 if unknown."""
    return _KINDS.index(kind) if kind in _KINDS else len(_KINDS)


def read(text: str) -> NamedColumns | None:
    """Columns of a take exported by OptiTrack Motive; None for other text.

    Frame, time, and position (and quaternion) of each asset. If no marker has a label, the
    pieces of the tracks that Motive lost are joined to tracks of the markers that move, with
    notes. Raises InputError for a damaged take, or if pieces cannot be joined.
    """
    start = _START.match(text) or _HEADLESS.match(text)
    if start is None and _HEADLESS.match(text.partition('\n')[2]):
        raise unexpected(1, text.partition('\n')[0], 'Format Version')
    if start is None:
        return None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip(' \t,;')]
    rows = [next(csv.reader([line], delimiter=start[1])) for _, line in lines]
    at = next(
        (i for i, row in enumerate(rows[:_MOST_HEAD_LINES]) if row[0].strip() == 'Frame'), None
    )
    if at is None:
        raise unexpected(*lines[min(len(lines), _MOST_HEAD_LINES) - 1], 'the line Frame, Time, …')
    take, above = {}, rows[: at - 1]
    unit = ''
    if _START.match(text):
        take, above = dict(zip(rows[0][::2], rows[0][1::2])), rows[1 : at - 1]
        unit = _UNITS.get(take.get('Length Units', '').strip().lower(), '')
        if not unit:
            raise unexpected(*lines[0], 'a Length Units such as Millimeters')
    head = {row[1].strip(): row for row in above if len(row) > 1}
    if 'Type' not in head and len(above) > 1 and {*_KIND_NAMES} & {*above[0]}:
        # Some versions leave the words for these lines out.
        head |= {'Type': above[0], 'Name': above[1]}
    axes, quantities = [cell.strip() for cell in rows[at]], rows[at - 1]
    width = len(axes)
    for what, row in (
        ('Type', head.get('Type')),
        ('Name', head.get('Name')),
        ('Position', quantities if 'Position' in quantities else None),
    ):
        if row is None or len(row) != width:
            raise unexpected(*lines[at], f'a line with {width} cells and {what} above this one')
    places: dict[tuple[str, str], dict[str, int]] = defaultdict(dict)
    turns: dict[tuple[str, str], dict[str, int]] = defaultdict(dict)
    for i in range(2, width):
        asset = head['Type'][i].strip(), head['Name'][i].strip()
        of = {'Position': places, 'Rotation': turns}.get(quantities[i].strip())
        if of is not None:
            if axes[i] in of[asset] or axes[i] not in (*'XYZW',):
                raise unexpected(*lines[at], f'X, Y and Z once for {" ".join(asset)}')
            of[asset][axes[i]] = i
    for asset, columns in places.items():
        if {*columns} != {*'XYZ'}:
            raise unexpected(*lines[at], f'X, Y and Z once for {" ".join(asset)}')
    names, used = ['Frame', 'Time [s]'], [0, 1]
    groups, quaternions = {}, {}
    kinds: dict[str, str] = {}
    for (kind, name), columns in places.items():
        likeliest = min((k for k, other in places if other == name), key=_likeliness)
        label = name if kind == likeliest else f'{kind} {name}'
        kinds[label] = kind
        groups[label] = tuple(range(len(used), len(used) + 3))
        names += [f'{label} {axis} [{unit}]' if unit else f'{label} {axis}' for axis in 'XYZ']
        used += [columns[axis] for axis in 'XYZ']
        turned = turns[kind, name]
        if len(turned) == 4:
            quaternions[label] = tuple(range(len(used), len(used) + 4))
            names += [f'{label} q{axis}' for axis in 'xyzw']
            used += [turned[axis] for axis in 'XYZW']
    if not groups:
        raise unexpected(*lines[at], 'X, Y and Z of a body or a marker')
    before = float('-inf')
    for (number, line), row in zip(lines[at + 1 :], rows[at + 1 :]):
        if len(row) != width or not (row[0].isdigit() and _NUMBER.fullmatch(row[1])):
            raise unexpected(number, line, f'a frame, its time and {width - 2} more cells')
        time_s = float(row[1].replace(',', '.'))
        if time_s <= before:
            raise unexpected(number, line, f'a time after {before:g} s')
        before = time_s
    labelled = [label for label in groups if not label.startswith('Unlabeled')]
    chosen = next(
        (found for kind in _KINDS if (found := [n for n in labelled if kinds[n] == kind])), ()
    )
    frames = rows[at + 1 :]
    commas = start[1] != ',' and any(',' in cell for row in frames[:100] for cell in row)
    table = [tuple(row[i].strip() for i in used) for row in frames]
    notes: tuple[str, ...] = ()
    if not labelled:
        for (number, line), cells in zip(lines[at + 1 :], table):
            if not all(_NUMBER.fullmatch(cell) for cell in cells if cell):
                raise unexpected(number, line, 'a number in each cell that is not empty')
        tracks, dropped_pieces = _moving_tracks(groups, table, commas, unit)
        if not tracks:
            raise unexpected(
                *lines[at],
                'a body or labels, as pieces of several markers without a label cannot be put '
                'together: label them in Motive, or make them a rigid body; this',
            )
        for track in tracks:
            where = groups[track.labels[0]]
            # The cells of each piece go into the columns of the first one.
            for i in np.flatnonzero(track.of > 0).tolist():
                moved = dict(zip(where, groups[track.labels[track.of[i]]], strict=True))
                table[i] = tuple(table[i][moved.get(c, c)] for c in range(len(used)))
        chosen = [track.labels[0] for track in tracks]
        pieces = sum(len(track.labels) for track in tracks)
        if pieces > len(tracks):
            notes = (f'{pieces} pieces of markers without a label are of {len(tracks)}',)
        if dropped_pieces:
            notes += (f'{dropped_pieces} pieces of markers without a label were left out',)
    version = (
        f'format {take.get("Format Version", "?").strip()}' if take else 'without its first line'
    )
    return NamedColumns(
        kind=f'a take of Motive ({version}){", " if unit else ""}{unit}',
        instrument='camera',
        names=tuple(names),
        notes=notes,
        rows=tuple(table),
        lines=tuple(number for number, _ in lines[at + 1 :]),
        decimal=',' if commas else '.',
        groups=groups,
        turns=quaternions,
        points=tuple(chosen),
    )


@dataclass(eq=False)
class _Track:
    """Track of one marker over n frames, put together from pieces that Motive did not identify.

    `labels`: of the pieces; `places`: positions, NaN where not seen, (n, 3); `of`: index of
    the piece in each frame, -1 if the marker was not seen, (n,).
    """

    labels: list[str]
    places: FloatArray
    of: IntArray

    @property
    def seen(self) -> BoolArray:
        """Whether the marker was seen in each frame, (n,)."""
        return self.of >= 0

    def extent(self) -> float:
        """Longest side of the box around the seen positions, in the file's unit.

        Raises ValueError if the marker was never seen.
        """
        return float(np.ptp(self.places[self.seen], axis=0).max())

    def distance(self, places: FloatArray, time_s: FloatArray) -> float:
        """Distance of a piece from this marker's seen or predicted position, in the file's unit.

        `places`: positions of the piece, NaN where not seen, (n, 3); `time_s`: of the frames,
        (n,). The median over frames in which both are seen; else from the marker's last
        position to the piece's first, less twice the way that the marker makes meanwhile at
        its last speed. Infinite if the marker was lost over 0.5 s before.
        """
        seen = np.isfinite(places[:, 0])
        both = seen & self.seen
        if both.any():
            distance = np.linalg.norm((places - self.places)[both], axis=1)
            return float(np.quantile(distance, 0.5, method='lower'))
        first = int(np.argmax(seen))
        seen_before = np.flatnonzero(self.seen[:first])
        if not len(seen_before) or time_s[first] - time_s[seen_before[-1]] > _LOST_S:
            return np.inf
        way = 0.0
        if len(seen_before) > 1:
            step = np.linalg.norm(self.places[seen_before[-1]] - self.places[seen_before[-2]])
            way = float(step) * (first - seen_before[-1]) / (seen_before[-1] - seen_before[-2])
        return max(
            0.0, float(np.linalg.norm(places[first] - self.places[seen_before[-1]])) - 2.0 * way
        )

    def add(self, label: str, places: FloatArray) -> None:
        """Add a piece, in place, in the frames in which the marker was not seen before.

        `label`: of the piece; `places`: its positions, NaN where not seen, (n, 3).
        """
        fresh = np.isfinite(places[:, 0]) & ~self.seen
        self.places[fresh] = places[fresh]
        self.of[fresh] = len(self.labels)
        self.labels.append(label)


def _moving_tracks(
    groups: Mapping[str, tuple[int, ...]],
    table: Sequence[tuple[str, ...]],
    commas: bool,
    unit: str,
) -> tuple[list[_Track], int]:
    """Tracks of the moving markers, joined from pieces, and the number of pieces left out.

    Motive gives a marker that it lost a new number: that begins a new piece. A piece is joined
    to the nearest marker within 10 mm (`_Track.distance`), else it begins a new marker. Markers
    that stay in their place are left out. The others are taken as one if never two are seen at
    once; else only those seen in over half of the frames with any of them are kept, which may
    be none. Pieces left out are those of all markers without a track here; empty pieces do not
    count. `groups`: label -> columns of a piece in `table`; `commas`: whether numbers have
    decimal commas; `unit`: of length, '' for m.
    """

    def column(i: int) -> FloatArray:
        cells = (row[i].replace(',', '.') if commas else row[i] for row in table)
        return np.array([float(cell) if cell else np.nan for cell in cells])

    time_s = column(1)
    pieces = {
        label: np.column_stack([column(i) for i in piece]) for label, piece in groups.items()
    }
    pieces = {label: piece for label, piece in pieces.items() if np.isfinite(piece[:, 0]).any()}
    tracks: list[_Track] = []
    same = _SAME_M / LENGTHS[unit or 'm']
    for label in sorted(pieces, key=lambda name: int(np.argmax(np.isfinite(pieces[name][:, 0])))):
        piece = pieces[label]
        distance = [track.distance(piece, time_s) for track in tracks]
        if not distance or min(distance) > same:
            none = np.full(len(table), -1)
            tracks.append(_Track([], np.full(piece.shape, np.nan), none))
            distance.append(0.0)
        tracks[int(np.argmin(distance))].add(label, piece)
    # What stays in its place is not on the arm.
    largest = max(track.extent() for track in tracks) if tracks else 0.0
    moving_markers = [track for track in tracks if track.extent() > _STATIC * largest]
    seen = np.sum([track.seen for track in moving_markers], axis=0)
    if len(moving_markers) > 1 and seen.max() == 1:
        # Never two of them: one, which was lost for longer.
        for track in moving_markers[1:]:
            for i, label in enumerate(track.labels):
                of_piece = np.where((track.of == i)[:, None], track.places, np.nan)
                moving_markers[0].add(label, of_piece)
        moving_markers = moving_markers[:1]
    elif len(moving_markers) > 1:
        moving_markers = [
            track for track in moving_markers if 2 * track.seen.sum() > (seen > 0).sum()
        ]
    return moving_markers, len(pieces) - sum(len(track.labels) for track in moving_markers)

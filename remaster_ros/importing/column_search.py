# SPDX-License-Identifier: Apache-2.0
"""Search for the columns of a table with joints, points and others, by header, choice or place."""

from __future__ import annotations

import re
import string
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from itertools import chain as flat

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import ColumnChoice, Columns, claim
from remaster_ros.importing.headers import AXES, TOKEN, Header, with_axis
from remaster_ros.importing.orientation_columns import find_orientation
from remaster_ros.importing.text_table import TextTable
from remaster_ros.importing.units import ANGLES, LENGTHS, PULSES, other_unit, split_unit

# Words of headers, in the languages of the programs and pendants seen so far.
_JOINT_WORDS = {
    *('a', 'j', 'q', 'ax', 'th', 'theta', 'θ', 'jt', 'jnt', 'axis', 'joint', 'joints'),
    *('achse', 'gelenk', 'eje', 'axe', 'asse', 'angle', 'position', 'positions', 'pos'),
    *('robot', 'lbr', 'rad', 'deg', 'state', 'states'),
}
_REPORTED = {
    *('actual', 'act', 'measured', 'meas', 'ist', 'reported', 'encoder', 'real', 'istwert'),
    *('istposition', 'gemessen', 'aktuell', 'mesuré', 'mesure', 'medido', 'misurato', 'actuel'),
}
_OTHER_JOINTS = {
    *('target', 'command', 'commanded', 'cmd', 'goal', 'desired', 'soll', 'setpoint', 'nominal'),
    *('velocity', 'vel', 'qd', 'speed', 'current', 'torque', 'effort', 'moment', 'tau', 'temp'),
    *('temperature', 'acceleration', 'error', 'err', 'offset', 'std', 'sigma', 'min', 'max'),
}
# Words of measured joint torques, N m, and words that may accompany them.
_TORQUES = {'torque', 'torques', 'tau', 'effort', 'efforts', 'moment'}
_OF_TORQUES = {'nm', 'motor', 'j'}
# What pendants call the joints, base to tip, as words of a header: UR in five languages, Yaskawa.
_PENDANTS = tuple(
    tuple(tuple(TOKEN.findall(name)) for name in names.split())
    for names in (
        'base shoulder elbow wrist1 wrist2 wrist3',
        'basis schulter ellbogen handgelenk1 handgelenk2 handgelenk3',
        'base hombro codo muñeca1 muñeca2 muñeca3',
        'base épaule coude poignet1 poignet2 poignet3',
        'base spalla gomito polso1 polso2 polso3',
        '基座 肩部 肘部 手腕1 手腕2 手腕3',
        's l u r b t',
        's l e u r b t',
    )
)
_SPREAD = {'std', 'stdev', 'stddev', 'sigma', 'sd', 'uncertainty', 'rms'}
# Words of an expanded uncertainty, U(95), which is no standard deviation.
_EXPANDED = {'u', '95'}
_TOOL = {
    *(
        'target',
        'goal',
        'tcp',
        'tool',
        'flange',
        'robot',
        'effector',
        'ref',
        'reference',
        'plan',
        *'rwvaf',
    ),
}
# Words of columns that are not measured positions.
_NOT_MEASURED = {
    *('nominal', 'nom', 'command', 'desired', 'soll', 'nennwert', 'sollwert', 'cad', 'planned'),
    *('theo', 'théorique', 'theoretical', 'teorico', 'teórico', 'nominale', 'expected', 'prog'),
    *('error', 'err', 'dev', 'deviation', 'delta', 'd', 'diff', 'rot', 'normal', 'offset'),
    *('vel', 'velocity', 'force', 'orientation', 'quaternion', 'rotation', 'tol', 'tolerance'),
    *('abw', 'abweichung', 'differenz', 'fehler', 'écart', 'ecart', 'desv', 'desviación'),
    *('scarto', 'residual', 'toleranz', 'quat', 'rotvec', 'rvec', 'euler'),
}
_NO_CHOICE = ColumnChoice()
# Remedy if several columns could be those of the points.
_NAME_POINTS = (
    'name the three columns of the point, three for each marker, or the markers, with --points'
)


def find_columns(
    table: TextTable,
    joint_names: Sequence[str],
    chosen: ColumnChoice = _NO_CHOICE,
    sliding: Collection[int] = (),
) -> Columns:
    """Assign a meaning to each column of a table.

    Parameters
    ----------
    joint_names
        Joints of the robot; a header that contains one of them is that joint's column.
    chosen
        Columns that the user chose. If the table lacks one that was chosen for the joints, all
        chosen for the joints are ignored, and the headers decide; likewise for the points.
    sliding
        Indices of prismatic joints, whose columns hold lengths.

    Raises
    ------
    InputError
        Several columns could have one meaning, one is chosen twice or has a unit that is not
        converted, or there is no header and the columns are unclear; with the remedy.
    """
    found = Columns()
    headers = [Header.of(name) for name in table.names]
    found.units = {i: header.unit for i, header in enumerate(headers) if header.unit}
    found.joints = _chosen_columns(table, chosen.joints, '--joints', found)
    found.points = _chosen_points(table, headers, chosen.points, found)
    for kind, name in (('time', chosen.time), ('name', chosen.names)):
        if name and name != 'none':
            found.others[kind] += _chosen_columns(table, (name,), f'--{kind}', found)
    if not table.has_header:
        return _columns_by_place(table, found, len(joint_names))
    taken = set(found.origin)
    if not found.joints:
        found.joints = _joint_columns(table, headers, joint_names, sliding, taken, found)
    if not found.points:
        found.points = _point_columns(table, headers, taken, found)
    for i in (*found.joints, *found.point):
        unit = other_unit(table.names[i])
        if unit and not (i in found.joints and unit.lower() in PULSES):
            raise InputError(
                f'{table.path}, column {table.names[i]}: {unit}, where one of '
                f'{", ".join(ANGLES if i in found.joints else LENGTHS)} is expected; convert the '
                'column'
            )
    find_orientation(headers, taken, found)
    for i, header in enumerate(headers):
        if i in taken:
            continue
        kind = header.kind()
        if kind and not (kind in ('time', 'date', 'clock') and chosen.time):
            found.others[kind].append(i)
            found.origin[i] = 'header'
    return found


def _chosen_columns(
    table: TextTable, names: Sequence[str], option: str, found: Columns
) -> tuple[int, ...]:
    """Indices of the columns in `names`, in that order; () if this table lacks one of them.

    `names`: headers that the user gave, with or without unit, case ignored, or numbers from 1;
    `option`: for the message. Notes the columns as ``told`` in ``found.origin``. Raises
    InputError if a column is named twice.
    """
    columns = []
    index = {name.casefold(): i for i, name in enumerate(table.names)}
    for i, name in enumerate(table.names):
        index.setdefault(split_unit(name)[0].casefold(), i)
    for name in names:
        at = index.get(name.casefold())
        if at is None and name.isdigit() and 1 <= int(name) <= len(table.names):
            at = int(name) - 1
        if at is not None:
            columns.append(at)
    # Of two tables the columns are in one: all of them, or none.
    if len(columns) < len(names):
        return ()
    if len(set(columns)) < len(columns):
        raise InputError(f'{table.path}: {option} names a column twice')
    found.origin.update(dict.fromkeys(columns, 'told'))
    return tuple(columns)


def _joint_columns(
    table: TextTable,
    headers: Sequence[Header],
    joint_names: Sequence[str],
    sliding: Collection[int],
    taken: set[int],
    found: Columns,
) -> tuple[int, ...]:
    """Columns of the joint angles, base to tip; () if none are found.

    Columns of the angles from which the arm came go into `found.from_joints`, of torques into
    `found.efforts`. All three are added to `taken` and to `found.origin`, in place. Reported
    angles are preferred to commanded ones, and sets of as many columns as the robot has
    joints. Raises InputError if several sets are left. `sliding`: indices of prismatic joints.
    """
    complete: dict[tuple[str, ...], tuple[int, ...]] = {}
    schemes = [tuple(tuple(Header.of(name).words) for name in joint_names)]
    schemes += [names for names in _PENDANTS if len(names) == len(joint_names)]
    for named in schemes:
        groups: dict[tuple[str, ...], dict[int, int]] = defaultdict(dict)
        for i, header in enumerate(headers):
            if i in taken:
                continue
            number, stem = _joint_number(header.words, named)
            slides = number is not None and number - 1 in sliding
            if header.unit and header.unit not in (LENGTHS if slides else ANGLES):
                continue
            # `x1 y1 z1 x2 …` are points.
            if number is not None and not set(stem) & {*AXES}:
                groups[stem].setdefault(number, i)
        found_here: dict[tuple[str, ...], tuple[int, ...]] = {}
        for stem, columns in groups.items():
            numbers = sorted(columns)
            if len(numbers) > 1 and numbers in (
                list(range(1, len(numbers) + 1)),
                list(range(len(numbers))),
            ):
                found_here[stem] = tuple(columns[number] for number in numbers)
        # A pendant's words are looked for where the robot's names and numbers do not give all.
        is_complete = any(len(columns) == len(joint_names) for columns in found_here.values())
        if is_complete or not complete:
            complete = found_here
        if is_complete:
            break
    came_from = [stem for stem in complete if 'from' in stem]
    if came_from:
        found.from_joints = complete[came_from[0]]
        claim(found, found.from_joints, taken)
    torques = [
        columns
        for stem, columns in complete.items()
        if _TORQUES & set(stem)
        and set(stem) <= _TORQUES | _OF_TORQUES | _JOINT_WORDS | _REPORTED | {*'*=#'}
        and len(columns) == len(joint_names)
    ]
    if len(torques) == 1:
        found.efforts = torques[0]
        claim(found, found.efforts, taken)
    usable = [stem for stem in complete if not _OTHER_JOINTS & set(stem) and stem not in came_from]
    known = [stem for stem in usable if set(stem) <= _JOINT_WORDS | _REPORTED | {*'*=#'}]
    best = [stem for stem in known if '=' in stem or _REPORTED & set(stem)] or known or usable
    sets = [complete[stem] for stem in best]
    sets = [columns for columns in sets if len(columns) == len(joint_names)] or sets
    chosen = _single_set(table, sets, 'the joint angles', 'name them, base to tip, with --joints')
    claim(found, chosen, taken)
    return chosen


def _single_set(
    table: TextTable, sets: Sequence[tuple[int, ...]], what: str, remedy: str
) -> tuple[int, ...]:
    """The only set of columns; () if there is none. Raises InputError if there are several.

    `what`, `remedy`: what the columns could be, and what to do, for the message.
    """
    if len(sets) > 1:
        listed = '; '.join(', '.join(table.names[i] for i in columns) for columns in sets[:4])
        raise InputError(f'{table.path}: these could all be {what}: {listed}; {remedy}')
    return sets[0] if sets else ()


def _joint_number(
    words: tuple[str, ...], named: Sequence[tuple[str, ...]]
) -> tuple[int | None, tuple[str, ...]]:
    """Number of the joint that a header names, and the header's words with a mark in its place.

    If the header contains the name of a joint of the robot, that joint's number, from 1: the
    name becomes '=', and the same number beside it '#'. Else the only number in a header of
    two words or more, as written; it becomes '*'. None and () if it has neither. `words`: of
    the header; `named`: words of each joint's name, base to tip.
    """
    for i, name in sorted(enumerate(named), key=lambda pair: -len(pair[1])):
        for short in (name, name[:-1] if name[-1:] == ('joint',) else name):
            for start in range(len(words) - len(short) + 1):
                if words[start : start + len(short)] == short:
                    # `J4 wrist 1` has the number of the joint beside its name.
                    around = [
                        ['#' if word == str(i + 1) else word for word in part]
                        for part in (words[:start], words[start + len(short) :])
                    ]
                    return i + 1, (*around[0], '=', *around[1])
    digits = [i for i, word in enumerate(words) if word.isdigit()]
    if len(digits) != 1 or len(words) < 2:
        return None, ()
    at = digits[0]
    return int(words[at]), (*words[:at], '*', *words[at + 1 :])


def _chosen_points(
    table: TextTable, headers: Sequence[Header], names: Sequence[str], found: Columns
) -> dict[str, tuple[int, ...]]:
    """Columns X, Y, Z by marker, as the user named them with --points; {} if the table lacks one.

    `names`: names of markers of this table; or else headers or numbers of columns, three for
    each marker. The columns are noted as ``told`` in ``found.origin``, and quaternions of
    named markers go into ``found.orientations``, in place. Raises InputError if a column is
    named twice, or their number is no multiple of three.
    """
    groups = {name: table.groups[name] for name in table.groups} or {
        _marker_label(table, columns): columns for columns in _xyz_groups(headers, set()).values()
    }
    folded = {name.casefold(): name for name in groups}
    if names and all(name.casefold() in folded for name in names):
        chosen = {folded[name.casefold()]: groups[folded[name.casefold()]] for name in names}
        found.origin.update(dict.fromkeys(flat.from_iterable(chosen.values()), 'told'))
        found.orientations = {name: table.turns[name] for name in chosen if name in table.turns}
        return chosen
    columns = _chosen_columns(table, names, '--points', found)
    if len(columns) % 3:
        raise InputError(
            f'{table.path}: --points names {len(columns)} columns; name X, Y and Z of each marker'
        )
    return _columns_by_marker(table, [columns[i : i + 3] for i in range(0, len(columns), 3)])


def _columns_by_marker(
    table: TextTable, sets: Sequence[tuple[int, ...]]
) -> dict[str, tuple[int, ...]]:
    """Columns X, Y, Z by marker name, from triples of columns; {} if there are none.

    The name of a single marker is ''. Several are named by their headers, or marker_1,
    marker_2, … if two of these are equal.
    """
    if len(sets) < 2:
        return dict.fromkeys([''] * len(sets), sets[0]) if sets else {}
    labels = [_marker_label(table, columns) for columns in sets]
    if len(set(labels)) < len(labels):
        labels = [f'marker_{i}' for i in range(1, len(sets) + 1)]
    return dict(zip(labels, sets, strict=True))


def _marker_label(table: TextTable, columns: Sequence[int]) -> str:
    """Name of a marker: the header of its X column without unit and axis.

    'marker_' is put before a name that is empty or a number.
    """
    name = split_unit(table.names[columns[0]])[0]
    stem = re.sub(r'(?<![^\W\d_])(?:[Pp]os(?:ition)?|[Pp])?[_ .-]?[xX](?![^\W\d_])', '', name)
    stem = stem.strip(' _-./:')
    return f'marker_{stem}' if stem.isdigit() or not stem else stem


def _xyz_groups(
    headers: Sequence[Header], taken: set[int], fewest: int = 3
) -> dict[tuple[str, ...], tuple[int, ...]]:
    """Groups of columns X, Y and Z, in this order, by the words of their headers.

    The key has '*' in place of the axis: ('tcp', '*') for ``tcp_x``. Groups with fewer than
    `fewest` of the three axes are left out, as are columns in `taken` and those with a unit
    that is no length.
    """
    groups: dict[tuple[str, ...], dict[str, int]] = defaultdict(dict)
    for i, header in enumerate(headers):
        if i in taken or (header.unit and header.unit not in LENGTHS):
            continue
        words = with_axis(header.words)
        axes = [word for word in words if word in AXES]
        if len(axes) == 1:
            stem = tuple('*' if word in AXES else word for word in words)
            groups[stem].setdefault(axes[0], i)
    return {
        stem: tuple(columns[axis] for axis in AXES if axis in columns)
        for stem, columns in groups.items()
        if len(columns) >= fewest
    }


def _point_columns(
    table: TextTable, headers: Sequence[Header], taken: set[int], found: Columns
) -> dict[str, tuple[int, ...]]:
    """Columns X, Y, Z of the measured points by marker; {} if there are none.

    Columns of standard deviations go into `found.stds`. Nominal positions and deviations are
    never taken, the robot's own tool only if there is nothing else. Adds the columns to
    `taken` and to `found.origin`, in place. Raises InputError if several could be the measured
    point, or an axis of it is missing.
    """
    if table.groups:
        chosen = {name: table.groups[name] for name in table.points or table.groups}
        found.orientations = {name: table.turns[name] for name in chosen if name in table.turns}
        for columns in (*chosen.values(), *found.orientations.values()):
            claim(found, columns, taken)
        return chosen
    complete = _xyz_groups(headers, taken)
    spreads = [stem for stem in complete if _SPREAD & set(stem) or 's' in stem]
    lettered = _lettered_stems(complete)
    usable = [stem for stem in complete if stem not in spreads and not _NOT_MEASURED & set(stem)]
    usable = [stem for stem in usable if not set(stem) >= _EXPANDED]
    best = [stem for stem in usable if stem in lettered or not _TOOL & set(stem)] or usable
    best = [stem for stem in best if _REPORTED & set(stem)] or best
    sets = [complete[stem] for stem in best]
    partial = [
        columns
        for stem, columns in _xyz_groups(headers, taken, 1).items()
        if _REPORTED & set(stem) and len(columns) < len(AXES)
    ]
    if best and partial and not any(_REPORTED & set(stem) for stem in best):
        raise InputError(
            f'{table.path}: {", ".join(table.names[i] for i in partial[0])} without the others of '
            'X, Y and Z; correct the header, or name the three of the measured point with --points'
        )
    # Names that differ in their numbers alone are several markers: `x1 y1 z1 x2 …`, `m1_x`; or in
    # letters from A on.
    unlike = {tuple(word for word in stem if not word.isdigit()) for stem in best}
    if len(unlike) > 1 and not {*best} <= lettered:
        _single_set(table, sets, 'the measured points', _NAME_POINTS)
    markers = _columns_by_marker(table, sets)
    claim(found, tuple(flat.from_iterable(sets)), taken)
    for stem in spreads:
        around = tuple(word for word in stem if word not in {*_SPREAD, 's'})
        for marker, marker_stem in zip(markers, best, strict=True):
            if len(best) == 1 or around == marker_stem:
                found.stds.setdefault(marker, complete[stem])
                claim(found, complete[stem], taken)
    return markers


def _lettered_stems(stems: Iterable[tuple[str, ...]]) -> set[tuple[str, ...]]:
    """Those groups of header words that differ in one letter only: A, B and so on without a gap.

    `stems`: words of each group of columns, lower case.
    """
    alike: dict[tuple[str, ...], dict[str, tuple[str, ...]]] = defaultdict(dict)
    for stem in stems:
        for i, word in enumerate(stem):
            if len(word) == 1 and word.isalpha():
                alike[(*stem[:i], '?', *stem[i + 1 :])][word] = stem
    return {
        stem
        for found in alike.values()
        if len(found) > 1 and sorted(found) == [*string.ascii_lowercase[: len(found)]]
        for stem in found.values()
    }


def _columns_by_place(table: TextTable, found: Columns, joints: int) -> Columns:
    """Complete `found`, in place, by the place of columns in a table without a header; return it.

    A name, joints, then X, Y, Z; or only the joints, or only X, Y, Z; row numbers may come
    first. `joints`: number of the robot's joints. Raises InputError if nothing is found and
    the number of numeric columns fits none of these.
    """
    if table.groups and not found.points:
        found.points, found.orientations = {**table.groups}, {**table.turns}
        for columns in (*found.points.values(), *found.orientations.values()):
            found.origin.update(dict.fromkeys(columns, 'place'))
    free = [i for i in range(len(table.names)) if i not in found.origin]
    numeric = [i for i in free if _is_numeric(table, i)]
    texts = sorted({*free}.difference(numeric))
    wanted = (0 if found.joints else joints, 0 if found.points else 3)
    first = numeric[:1] if _counts_up(table, numeric) else []
    for need_joints, need_point in ((*wanted,), (0, wanted[1]), (wanted[0], 0)):
        for lead in ([], first):
            if need_joints + need_point and len(numeric) - len(lead) == need_joints + need_point:
                places = numeric[len(lead) :]
                if free.index(places[-1]) - free.index(places[0]) >= len(places):
                    # Text between them: this is no table of that kind.
                    continue
                if need_joints:
                    found.joints = tuple(places[:need_joints])
                if need_point:
                    found.points = {'': tuple(places[need_joints:])}
                if texts or lead:
                    found.others['name'] += [*texts[:1], *lead]
                found.origin.update(dict.fromkeys([*texts[:1], *lead, *places], 'place'))
                return found
    if found.joints or found.points:
        return found
    raise InputError(
        f'{table.path}: no header, and {len(numeric)} columns of numbers, which is neither a '
        f'point (3), nor {joints} joints, nor both; give it a header line, or name the columns '
        'by their numbers: --points 2,3,4 --joints 5,6,…'
    )


def _counts_up(table: TextTable, numeric: Sequence[int]) -> bool:
    """Whether the first numeric column holds different whole numbers, as row numbers do.

    `numeric`: indices of the numeric columns; False if there are none.
    """
    if not numeric:
        return False
    cells = [row[numeric[0]] for row in table.rows]
    return all(cell.isdigit() for cell in cells) and len(set(cells)) == len(cells)


def _is_numeric(table: TextTable, column: int) -> bool:
    """Whether a column has a number, and no other text than marks for missing values."""
    try:
        values = [table.number(row, column) for row in range(len(table.rows))]
    except InputError:
        return False
    return any(value is not None for value in values)

# SPDX-License-Identifier: Apache-2.0
"""Make a session of anybody's table of joint angles and points, or of a ROS bag."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from remaster_ros.calibration.dynamics import estimate_moving, moving_words
from remaster_ros.calibration.gauge_words import counted
from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.cli.console import progress_bar, show, tell
from remaster_ros.cli.import_options import (
    DECIMALS,
    SEPARATORS,
    add_columns,
    add_corrections,
    add_files,
    add_motion,
    add_robot,
    add_session,
)
from remaster_ros.cli.options import xacro_arguments
from remaster_ros.errors import InputError, InsufficientDataError, MistakeFoundError
from remaster_ros.importing.assemble import (
    SessionOptions,
    assemble,
    refuse_outside_limits,
    with_controller_coupling,
    without_whole_turns,
)
from remaster_ros.importing.bags import is_bag, read_bag, read_streams
from remaster_ros.importing.columns import ColumnChoice
from remaster_ros.importing.moving import MovingOptions, moving_session, with_proof
from remaster_ros.importing.raw_rows import RawRows, from_tool
from remaster_ros.importing.rows import TableOptions, read_rows
from remaster_ros.importing.sense import Sense, check_sense
from remaster_ros.importing.sessions import arrangement_of, corrected_session
from remaster_ros.importing.turns import with_orientation
from remaster_ros.importing.units import ANGLES, LENGTHS
from remaster_ros.kinematics.pad_angles import pad_in_words
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.session.cells.robot_description import read_arm
from remaster_ros.session.cells.workcell import Workcell, read_cell
from remaster_ros.session.records.reader import HEADER, read_session, write_session
from remaster_ros.types import Session

log = logging.getLogger('remaster_ros')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster import``."""
    add_files(parser)
    add_robot(parser)
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    add_motion(parser)
    add_columns(parser)
    add_corrections(parser)
    add_session(parser)


def run(args: argparse.Namespace) -> int:
    """Read the files, show what was read, test it with the robot, and write a session; return 0.

    A session folder is mended (`_mend`), a bag with --moving read by `_import_moving`. Raises
    InputError if files or options are invalid, InsufficientDataError if the data do not fit the
    robot (unless --unchecked); nothing is written then.
    """
    if args.moving and (len(args.files) > 1 or not is_bag(args.files[0])):
        bag = args.files[-1] / 'bag'
        raise InputError(
            f'{args.files[-1]}: --moving takes one bag, with joint states and frames as recorded'
            + (f'; that of this session is {bag}' if is_bag(bag) else '')
        )
    if args.proof is not None and not args.moving:
        raise InputError('--proof is for a bag of a moving arm: give it with --moving')
    if len(args.files) == 1 and (args.files[0] / HEADER).exists():
        return _mend(args)
    if args.urdf is None and args.cell is None:
        raise InputError('the table is of which arm? give --urdf FILE or --cell CELL')
    if args.xacro_argument and args.urdf is None:
        raise InputError('--xacro-argument is for a xacro file: give it with --urdf FILE')
    cell = None if args.cell is None else read_cell(args.cell)
    if cell is None:
        urdf, chain = read_arm(
            args.urdf,
            args.base_link,
            args.tip_link,
            xacro_arguments(args.xacro_argument),
            args.package_path,
            trusted=args.trust,
            tables=args.files,
        )
    else:
        urdf, base = cell.urdf_text, args.base_link or cell.robot.base_link
        chain = SerialChain.from_urdf(urdf, base, args.tip_link or cell.robot.tip_link)
    if args.moving:
        return _import_moving(args, cell, urdf, chain)
    with progress_bar(args.quiet or args.json) as progress:
        progress('reading', 0.0)
        options = _session_options(args, cell)
        rows = with_orientation(_read(args, urdf, chain).in_order(), chain, options)
        if args.on_tool:
            rows = from_tool(rows)
        options, counted = with_controller_coupling(rows, chain, options)
        notes = f'imported from {", ".join(path.name for path in args.files)}'
        rng = np.random.default_rng(args.seed)
        session, how = assemble(rows, urdf, chain, options, rng, notes)
        # What is not of the columns is undone in the session that they make.
        arrangement = arrangement_of(
            session,
            chain.joint_names,
            shift=args.shift_points,
            exchange=args.exchange_markers,
            turn=args.turn_tool,
        )
        session = corrected_session(session, arrangement)
        session = replace(session, accuracy_option=args.accuracy_option)
        sense = check_sense(session, rows, progress, args.never_mastered)
    session, turned = without_whole_turns(session, chain)
    how += [*counted, *filter(None, [turned]), *_names_not_used(args, rows)]
    # Other makers than ABB use RAPID: such targets do not identify the maker.
    if rows.maker == 'KUKA' and not args.accuracy_option:
        how.append(
            "was the maker's accuracy option ($ABS_ACCUR) on? The result belongs to that state "
            'alone: say --accuracy-option active or inactive'
        )
    show(args.quiet or args.json, _as_text(rows, session, how))
    if sense.fits or args.unchecked:
        refuse_outside_limits(rows, chain, session.measurements.q)
        write_session(args.out, session)
    tell(args, _as_json(args.out if sense.fits or args.unchecked else None, rows, sense))
    if not sense.fits and not args.unchecked:
        remedy = f'to write it so, add {sense.options}' if sense.options else 'nothing was written'
        raise InsufficientDataError(
            f'{sense.sentence}; {remedy}; to write it as it is, add --unchecked'
        )
    if sense.warning:
        log.warning('%s', sense.warning)
    show(args.quiet or args.json, sense.sentence, _written(args.out))
    return 0


def _mend(args: argparse.Namespace) -> int:
    """Write a copy of a session with a mistake corrected, as the options say; return 0.

    Raises InputError for options that do not go with a session or a joint that slides,
    InsufficientDataError if it still does not fit (unless --unchecked). Nothing is written
    then.
    """
    folder: Path = args.files[0]
    points = [name.lower() for name in args.points]
    if args.points and points not in ([*'xyz'], [*'yxz'], ['y_m', 'x_m', 'z_m']):
        raise InputError('--points: of a session X and Y can be exchanged; give y_m,x_m,z_m')
    session = read_session(folder, within_limits=False)
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    for joint in np.flatnonzero(chain.slides)[:1]:
        raise InputError(
            f"{folder}: joint '{chain.joint_names[joint]}' slides, and a session of such an arm "
            'is not mended: correct its table and import that'
        )
    arrangement = arrangement_of(
        session,
        chain.joint_names,
        order=args.joints,
        couple=args.couple,
        reverse=tuple(args.reverse),
        add_deg=args.offset,
        angle_scale=args.multiply_angles * ANGLES[args.angles or 'rad'],
        length_scale=args.multiply_points * LENGTHS[args.length or 'm'],
        mirrored=bool(points) and points[0].startswith('y'),
        shift=args.shift_points,
        exchange=args.exchange_markers,
        turn=args.turn_tool,
        tip_link=args.tip_link or '',
    )
    with progress_bar(args.quiet or args.json) as progress:
        progress('trying', 0.0)
        session = corrected_session(session, arrangement)
        if args.accuracy_option:
            session = replace(session, accuracy_option=args.accuracy_option)
        if not args.unchecked:
            try:
                sound_estimate(session)
            except MistakeFoundError as error:
                raise InsufficientDataError(
                    f'{error}: {error.options}; nothing was written; to write it as it is, add '
                    '--unchecked'
                ) from None
    write_session(args.out, without_whole_turns(session, chain)[0])
    content = {'session': str(args.out), 'columns': {}, 'warnings': [], 'hint': ''}
    tell(args, content, _written(args.out))
    return 0


def _import_moving(
    args: argparse.Namespace, cell: Workcell | None, urdf: str, chain: SerialChain
) -> int:
    """Write the session of a bag whose arm moved; print how it was read; return 0.

    ``cell``: None if the arm is given by a URDF; ``urdf, chain``: the arm. Raises as `run`.
    """
    for option, given in (
        ('--couple', args.couple),
        ('--reverse', args.reverse),
        ('--offset', args.offset),
        ('--shift-points', args.shift_points),
        ('--exchange-markers', args.exchange_markers),
        ('--turn-tool', args.turn_tool[0]),
        ('--on-tool', args.on_tool),
    ):
        if given:
            raise InputError(f'{option} is not for --moving: import the standstills with it')
    path = args.files[0]
    topics, places, std = {}, {}, args.marker_std_mm
    if cell is not None:
        topics = {
            f'/{topic.lstrip("/")}': (name, marker)
            for name, sensor in cell.sensors.items()
            for marker, topic in sensor.topics.items()
        }
        places = {name: np.array(place) for name, place in cell.markers.items()}
        std = 1e3 * cell.marker_std_m if std is None else std
    with progress_bar(args.quiet or args.json) as progress:
        progress('reading', 0.0)
        links = parse_urdf(urdf).links
        joints, streams, columns = read_streams(
            path, chain, args.joints, args.points, args.length, links, topics
        )
        if args.marker_mm is not None:
            if len(streams) > 1:
                raise InputError('--marker-mm is for one marker; give several by --cell')
            places = {streams[0].marker: 1e-3 * np.array(args.marker_mm)}
        progress('finding the clocks', 0.3)
        options = MovingOptions(
            places=places,
            marker_std_m=None if std is None else 1e-3 * std,
            clock_offset_s=args.clock_offset,
            hold_out=args.hold_out,
            notes=f'imported from {path.name}, moving',
            accuracy_option=args.accuracy_option,
        )
        rng = np.random.default_rng(args.seed)
        session, how = moving_session(str(path), joints, streams, chain, urdf, options, rng)
        session, turned = without_whole_turns(session, chain)
        if args.proof is not None:
            moving_poses = len(np.unique(session.measurements.pose))
            session = with_proof(session, joints, str(args.proof), read_session(args.proof))
            poses = len(np.unique(session.measurements.pose)) - moving_poses
            how.append(f'{counted(poses, "pose")} at standstill of {args.proof}, held out')
        fits = ''
        if not args.unchecked:
            progress('trying', 0.8)
            try:
                found = sound_estimate(session, fitted=estimate_moving)
            except InsufficientDataError as error:
                raise InsufficientDataError(
                    f'{error}; nothing was written; to write it as it is, add --unchecked'
                ) from None
            fits = moving_words(found)
    width = max(map(len, columns))
    lines = [f'  {column:{width}s}  {meaning}' for column, meaning in columns.items()]
    lines += [*how, *filter(None, (turned, fits))]
    show(args.quiet or args.json, '\n'.join((f'{path}: the arm moving', *lines)))
    write_session(args.out, session)
    content = {'session': str(args.out), 'columns': columns, 'warnings': [], 'hint': ''}
    content |= {'clock_offset_s': session.clock_offset_s}
    tell(args, content, _written(args.out))
    return 0


def _written(out: Path) -> str:
    """Return the message that names the written session and the next command."""
    return f'written: {out}; go on with: remaster fit {quote(str(out))} --out …'


def _read(args: argparse.Namespace, urdf: str, chain: SerialChain) -> RawRows:
    """Return the rows of the files, tables or one bag.

    Raises InputError for a bag among several files, and if a file cannot be read.
    """
    bags = [path for path in args.files if is_bag(path)]
    if bags:
        if len(args.files) > 1:
            raise InputError(f'{bags[0]}: a bag is imported alone; give one file')
        return read_bag(
            bags[0],
            chain,
            args.joints,
            args.points,
            args.length,
            args.clock_offset,
            parse_urdf(urdf).links,
        )
    return read_rows(
        args.files,
        chain,
        TableOptions(
            separator=SEPARATORS.get(args.separator, ''),
            decimal=DECIMALS.get(args.decimal, ''),
            encoding=args.encoding,
            angles=args.angles,
            length=args.length,
            chosen=ColumnChoice(args.joints, args.points, args.time, args.names),
            join=args.join,
            within_s=args.within,
            clock_offset_s=args.clock_offset,
            pulses_per_degree=args.pulses_per_degree,
            sheets=tuple(args.sheet),
        ),
    )


def _session_options(args: argparse.Namespace, cell: Workcell | None) -> SessionOptions:
    """Return the options of the session; sensor, marker and its place from the cell if not given.

    ``cell``: None for none: names are 'sensor' and 'marker' then, the place is unknown.
    """
    sensor, marker, place, std = args.sensor, args.marker, args.marker_mm, args.marker_std_mm
    if cell is not None:
        sensor = sensor or cell.aim_at
        marker = marker or cell.sensors[cell.aim_at].marker
        if place is None and marker in cell.markers:
            place = [1e3 * value for value in cell.markers[marker]]
            std = 1e3 * cell.marker_std_m if std is None else std
    return SessionOptions(
        couple=tuple(args.couple),
        reverse=tuple(args.reverse),
        add_deg=tuple(args.offset),
        sensor=sensor or 'sensor',
        marker=marker or 'marker',
        marker_m=None if place is None else tuple(1e-3 * value for value in place),
        marker_std_m=None if std is None else 1e-3 * std,
        hold_out=args.hold_out,
        visited_in_order=args.visited_in_order,
        on_tool=args.on_tool,
        sensor_kind=args.sensor_kind,
    )


def _names_not_used(args: argparse.Namespace, rows: RawRows) -> Iterator[str]:
    """Yield a warning for each of --sensor and --marker that the table's own names override."""
    for what, given in (('sensor', args.sensor), ('marker', args.marker)):
        named = sorted(set(rows.labels.get(what, ())))
        if given and named and given not in named:
            yield f'--{what} {given} is not used: the table names its {what}s ({", ".join(named)})'


def _as_text(rows: RawRows, session: Session, how: list[str]) -> str:
    """Return a summary of the tables and of their interpretation, as text.

    ``rows``: as read; ``session``: made of them; ``how``: lines that are added at the end.
    """
    width = max(map(len, rows.columns))
    lines = [*rows.description]
    lines += [f'  {column:{width}s}  {meaning}' for column, meaning in rows.columns.items()]
    lines += [f'warning: {warning}' for warning in rows.warnings]
    lines.append(
        f'{len(session.measurements)} rows; joints between {session.base_link} and '
        f'{session.tip_link}; '
        + ('times as given' if session.timed else 'no times: causes driven by time are untestable')
    )
    if session.controller is not None:
        words = pad_in_words(session.controller)
        lines += [f'on the pad: {", ".join(words)}'] if words else []
    return '\n'.join([*lines, *how])


def _as_json(out: Path | None, rows: RawRows, sense: Sense) -> dict[str, Any]:
    """Return the summary of an import for --json: session, columns, warnings, fit, rows far off.

    ``out``: folder of the session, None if it is not written; ``sense``: whether it fits the
    arm.
    """
    return {
        'session': None if out is None else str(out),
        'columns': rows.columns,
        'warnings': [*rows.warnings, *filter(None, [sense.warning])],
        'hint': '' if sense.fits else f'{sense.sentence}; {sense.options}'.rstrip('; '),
        'fits': sense.fits,
        'rows_off': [{'where': row, 'error_mm': 1e3 * error} for row, error in sense.rows_off],
        'error_mm': None if sense.error_m is None else 1e3 * sense.error_m,
    }

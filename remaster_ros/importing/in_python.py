"""Sessions from Python: of arrays or a data frame, or of files as the command reads them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.importing.assemble import (
    SessionOptions,
    as_counted,
    assemble,
    refuse_outside_limits,
    without_whole_turns,
)
from remaster_ros.importing.rows import RawRows, TableOptions, read_rows
from remaster_ros.importing.sense import check_sense
from remaster_ros.importing.turns import oriented
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, Session


def of_arrays(joints: Any, points: Any, robot: tuple[str, SerialChain], seed: int) -> Session:
    """Return the session of joints, rad, and points, m, row by row; see `session_from`."""
    urdf, chain = robot
    q = _numbers(joints, 'joints', chain.joint_names)
    position = _numbers(points, 'points', ('x', 'y', 'z'))
    if len(q) != len(position):
        raise InputError(f'joints have {len(q)} rows, points {len(position)}; give a point each')
    n = len(q)
    rows = RawRows(
        where=tuple(f'row {i}' for i in range(n)),
        joint_columns=chain.joint_names,
        q=q,
        from_q=np.full(q.shape, np.nan),
        position=position,
        std=np.full((n, 3), np.nan),
        stamp_s=None,
        labels={},
        temperature_c=np.full(n, np.nan),
        samples=np.full(n, -1.0),
        columns={},
        description=(),
        warnings=(),
    )
    return _made(rows, urdf, chain, SessionOptions(), seed, 'from arrays')


def of_files(
    paths: Sequence[Path],
    robot: tuple[str, SerialChain],
    options: TableOptions,
    corrections: SessionOptions,
    seed: int,
) -> Session:
    """Return the session of one table or of two that are joined; see `import_table`."""
    urdf, chain = robot
    rows = oriented(read_rows(paths, chain, options).in_order(), chain, corrections)
    notes = f'imported from {", ".join(path.name for path in paths)}'
    return _made(rows, urdf, chain, corrections, seed, notes)


def _made(
    rows: RawRows,
    urdf: str,
    chain: SerialChain,
    corrections: SessionOptions,
    seed: int,
    notes: str,
) -> Session:
    options, _ = as_counted(rows, chain, corrections)
    session, _ = assemble(rows, urdf, chain, options, np.random.default_rng(seed), notes)
    sense = check_sense(session, rows, lambda *_: None)
    if not sense.fits:
        raise InsufficientDataError('; '.join(filter(None, (sense.sentence, sense.options))))
    session, _ = without_whole_turns(session, chain)
    refuse_outside_limits(rows, chain, session.measurements.q)
    return session


def _numbers(given: Any, what: str, names: Sequence[str]) -> FloatArray:
    """Return an array (n, len(names)); of a data frame or a dict the columns of these names."""
    columns = getattr(given, 'columns', None)
    if columns is None and isinstance(given, dict):
        columns = given.keys()
    if columns is not None:
        absent = [name for name in names if name not in [*columns]]
        if absent:
            raise InputError(
                f'{what}: there is no column {absent[0]!r}; it has {", ".join(map(str, columns))}'
            )
        given = np.column_stack([np.asarray(given[name], dtype=float) for name in names])
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f'{what}: not an array of numbers') from None
    if values.ndim != 2 or values.shape[1] != len(names):
        raise InputError(f'{what}: {values.shape} is not (rows, {len(names)}): {", ".join(names)}')
    if not np.isfinite(values).all():
        row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        raise InputError(f'{what}: row {row} is not finite; leave it out of joints and points')
    return values

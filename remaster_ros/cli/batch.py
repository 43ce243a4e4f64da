# SPDX-License-Identifier: Apache-2.0
"""Fit, discover and check many sessions: a row each, resumable, and a page over all.

Sessions are distributed to workers that are kept: spawned processes of this computer, or those of
a Dask scheduler. The key of a row is a checksum of its inputs, so that an interrupted batch does
the remaining sessions when it is called again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from remaster_ros.cli.batch_workers import local_pool, scheduled, work_off
from remaster_ros.cli.console import progress_bar, tell
from remaster_ros.cli.options import integer
from remaster_ros.errors import InputError, InsufficientDataError, RemasterError
from remaster_ros.session.files import make_folder, writing
from remaster_ros.session.manifest import MANIFEST
from remaster_ros.session.records.journal import Journal
from remaster_ros.version import __version__

FORMAT = 'remaster-batch/1'
ROWS = 'rows.jsonl'
PAGE = 'batch.html'
FINAL = ('done', 'no answer')
"""What the data say. An error may be the disk's, and a killed worker the memory's: such sessions
are tried again by the next call."""
AHEAD = 4
"""Sessions that each worker of a scheduler has waiting, so that none is idle meanwhile."""
log = logging.getLogger('remaster_ros')
_READ = ('.yaml', '.csv', '.urdf', '.xml')


@dataclass(frozen=True)
class Job:
    """One session to evaluate in a batch, and where its results go; picklable."""

    key: str  # Of its files, this version, the seed and the baseline
    # Its folder, and where its results go
    session: str
    out: str
    seed: int
    baseline: str = ''  # A compensation.json to check against; '' for none


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster batch``."""
    parser.add_argument(
        'session', metavar='SESSION', type=Path, nargs='+', help='session folders, in this order'
    )
    parser.add_argument(
        '--out', metavar='DIR', type=Path, required=True, help='folder of rows, results and page'
    )
    parser.add_argument(
        '--baseline',
        metavar='COMPENSATION',
        type=Path,
        help='apply/compensation.json: compare each session with it, as a first check does',
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        '--workers',
        type=integer(1),
        default=os.cpu_count() or 1,
        metavar='N',
        help='processes of this computer (default: one for each processor)',
    )
    where.add_argument(
        '--scheduler',
        metavar='ADDRESS',
        help="a Dask scheduler's address, such as tcp://127.0.0.1:8786; its workers need this "
        'version, and the sessions and DIR under the same paths',
    )
    parser.add_argument(
        '--insecure',
        action='store_true',
        help="take a scheduler on another computer without TLS: whoever reaches it runs anybody's "
        'code on its workers',
    )
    parser.add_argument(
        '--json', action='store_true', help='print the rows, and what they say together, as JSON'
    )


def run(args: argparse.Namespace) -> int:
    """Evaluate all sessions without a final row yet; then write the page over all of them.

    Sessions that ended with an error or a killed worker are tried again. Returns 0 if any
    session has the status 'done', else 1. Raises InputError: the folder holds other results,
    or the scheduler cannot be used.
    """
    baseline = '' if args.baseline is None else str(args.baseline.resolve())
    folders = list(dict.fromkeys(folder.resolve() for folder in args.session))
    make_folder(args.out)
    _refuse_foreign(args.out)
    jobs = [_job(folder, args.out.resolve(), args.seed, baseline) for folder in folders]
    rows = Journal(args.out / ROWS)
    try:
        if rows.lost:
            log.warning('%s', rows.lost)
        said = _said(rows, args.out / ROWS)
        done = {key: row for key, row in said.items() if row.get('status') in FINAL}
        # Copies of a session have one row.
        remaining = list({job.key: job for job in jobs if job.key not in done}.values())
        with progress_bar(args.quiet or args.json) as progress:
            worked_on = 0

            def finished(job: Job, row: dict[str, Any]) -> None:
                nonlocal worked_on
                row = {'format': FORMAT, 'key': job.key, 'session': job.session, **row}
                done[job.key] = row
                if row != said.get(job.key):
                    rows.append(row)
                worked_on += 1
                progress('sessions', worked_on / len(remaining))

            if remaining and args.scheduler is not None:
                with scheduled(args.scheduler, insecure=args.insecure) as (executor, workers):
                    work_off(remaining, worked, lambda: executor, AHEAD * workers, finished)
            elif remaining:
                count = min(args.workers, len(remaining))
                work_off(remaining, worked, lambda: local_pool(count), count, finished)
    finally:
        rows.close()
    # A session may have been moved since, or be a copy.
    rows_of_page = [{**done[job.key], 'session': job.session} for job in jobs]
    from remaster_ros.reports.batch_page import summary_of, write_batch_page

    over_all = summary_of(rows_of_page)
    write_batch_page(args.out / PAGE, rows_of_page, over_all)
    content = {'format': FORMAT, 'rows': rows_of_page, **over_all}
    tell(args, content, *over_all['lines'], f'written: {args.out / PAGE}')
    return 0 if any(row['status'] == 'done' for row in rows_of_page) else 1


def _refuse_foreign(folder: Path) -> None:
    """Raise InputError if the folder has results of another command, or is a session.

    ``folder``: output of the batch; one that has rows of a batch already passes.
    """
    from remaster_ros.reports.fit_json import DISCOVERY_FILE, FIT_FILE, WRITTEN
    from remaster_ros.session.records.reader import HEADER

    with writing(folder):
        there = sorted(path.name for path in folder.iterdir())
    foreign = {FIT_FILE, DISCOVERY_FILE, HEADER, *WRITTEN}.intersection(there)
    if foreign and ROWS not in there:
        raise InputError(
            f'{folder}: holds {", ".join(sorted(foreign))}, not written by this command; name '
            'another folder'
        )


def _job(folder: Path, out: Path, seed: int, baseline: str) -> Job:
    """Return the job of a session, whose key is a checksum of version, seed, and its files.

    An unreadable file raises nothing: it will be the error of its row. ``folder``: the
    session; ``out``: folder of the batch, in which the session gets a folder of its own;
    ``baseline``: path of a compensation.json, '' for none.
    """
    made_of = hashlib.sha256(f'{__version__} {seed}'.encode())
    files = sorted(
        path for path in folder.glob('*') if path.suffix in _READ or path.name == MANIFEST
    )
    for path in [*files, *([Path(baseline)] if baseline else [])]:
        made_of.update(f'\0{path.name}\0{_digest(path)}\0'.encode())
    key = made_of.hexdigest()
    place = hashlib.sha256(str(folder).encode()).hexdigest()[:8]
    return Job(key, str(folder), str(out / f'{folder.name}-{place}'), seed, baseline)


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file; '' if it is not a readable regular file.

    Reading a pipe or a device may never end.
    """
    try:
        if not path.is_file():
            return ''
        with path.open('rb') as file:
            return hashlib.file_digest(file, 'sha256').hexdigest()
    except OSError:
        return ''


def _said(rows: Journal, path: Path) -> dict[str, dict[str, Any]]:
    """Return the last row of each key in the journal of an earlier run, key -> row.

    ``rows``: the journal; ``path``: its path, for the error.

    Raises InputError, with the line, if a record is no row of a batch.
    """
    rows_by_key = {}
    for line, row in enumerate(rows.records, 1):
        if row.get('format') != FORMAT or not isinstance(row.get('key'), str):
            raise InputError(f'{path}, line {line}: is no row of a batch; name another folder')
        rows_by_key[row['key']] = {name: value for name, value in row.items() if name != 'crc32'}
    return rows_by_key


def worked(job: Job) -> dict[str, Any]:
    """Fit, discover and check a session in a worker; return the content of its row.

    ``status``: done, 'no answer' (the data do not allow one) or error, with its text in ``error``;
    nothing is raised. The results are those of the commands with this seed, whichever worker
    computes them.
    """
    try:
        return {'status': 'done', **_results(job)}
    except InsufficientDataError as error:
        return {'status': 'no answer', 'error': str(error)}
    except RemasterError as error:
        return {'status': 'error', 'error': str(error)}
    except MemoryError:
        return {'status': 'error', 'error': 'the memory does not suffice; use fewer workers'}
    except Exception as error:
        # A worker must go on with the next session, and no traceback reaches a user.
        return {'status': 'error', 'error': f'{type(error).__name__}: {error}'}


def _results(job: Job) -> dict[str, Any]:
    """Evaluate a session; write the results into `job.out`, and return the row's columns.

    Columns: fit, discovery and, with a baseline, check. An InsufficientDataError of the
    search, or an error of the check, becomes the text of its column; errors of reading and
    fitting are raised.
    """
    import numpy as np

    from remaster_ros.calibration.fit import fit_session
    from remaster_ros.cli.sessions import read_together
    from remaster_ros.discovery.discover import discover_session
    from remaster_ros.reports.discovery_json import DISCOVERY_FILE
    from remaster_ros.reports.fit_json import FIT_FILE
    from remaster_ros.reports.result_folder import save_discovery, save_fit

    session, _ = read_together([Path(job.session)])
    folder = Path(job.out)
    fitted = fit_session(session, rng=np.random.default_rng(job.seed))
    make_folder(folder / 'fit')
    save_fit(fitted, folder / 'fit', figures=False)
    row: dict[str, Any] = {'fit': _of_fit(folder / 'fit' / FIT_FILE)}
    try:
        discovery = discover_session(session, rng=np.random.default_rng(job.seed))
        make_folder(folder / 'discovery')
        save_discovery(discovery, folder / 'discovery', figures=False)
        row['discovery'] = _of_discovery(folder / 'discovery' / DISCOVERY_FILE)
    except InsufficientDataError as error:
        row['discovery'] = {'error': str(error)}
    if job.baseline:
        try:
            row['check'] = _of_check(job, session)
        except RemasterError as error:
            row['check'] = {'error': str(error)}
    return row


def _of_fit(path: Path) -> dict[str, Any]:
    """Return robot, judgement, held-out errors, mm, and offsets of a fit.json as plain data.

    Raises OSError, ValueError, KeyError or TypeError if it is unreadable or of another form.
    """
    content = json.loads(path.read_bytes())
    held_out = (content['accuracy']['validation'] or {}).get('post_registration') or {}
    return {
        'robot': content['robot']['name'],
        'judgement': content['judgement']['mood'],
        'headline': content['judgement']['headline'],
        'held_out_mm': {
            side: None if not held_out.get(side) else held_out[side]['mean_mm']
            for side in ('before', 'after')
        },
        'joints': [_offset(offset) for offset in content['joint_offsets']],
    }


def _offset(offset: Mapping[str, Any]) -> dict[str, Any]:
    """Return mean and standard deviation of an offset of fit.json as plain data.

    In its unit there (deg, or mm for a prismatic joint); None if it is not identifiable.
    """
    known, unit = offset['identifiable'], offset.get('unit', 'deg')
    row = {'joint': offset['joint'], 'mean_deg': None, 'std_deg': None}
    row |= {} if unit == 'deg' else {'unit': unit}
    row |= {f'{key}_{unit}': offset[f'{key}_{unit}'] if known else None for key in ('mean', 'std')}
    narrower = f'std_if_exactly_drawn_{unit}'
    return row | ({narrower: offset[narrower]} if known and narrower in offset else {})


def _of_discovery(path: Path) -> dict[str, Any]:
    """Return verdict, judgement and effects (sizes in mm) of a discovery.json.

    Raises OSError, ValueError, KeyError or TypeError if it is unreadable or of another form.
    """
    content = json.loads(path.read_bytes())
    return {
        'verdict': content['verdict'],
        'judgement': content['judgement']['mood'],
        'headline': content['judgement']['headline'],
        'effects': [
            {
                **{key: effect[key] for key in ('name', 'joints', 'title')},
                'size_mm': 1e3 * effect['size_m'],
            }
            for effect in content['effects']
        ],
    }


def _of_check(job: Job, session: Any) -> dict[str, Any]:
    """Return the result of a check of a session against the baseline, as `content_of`.

    Raises InputError if the baseline is invalid or of another arm.
    """
    from remaster_ros.cli.check import content_of, measured_of
    from remaster_ros.cli.verify import require_same_arm
    from remaster_ros.compensation.checking import SMALLEST_M, judge
    from remaster_ros.compensation.file import read_compensation
    from remaster_ros.compensation.iso9283 import iso_figures

    baseline = read_compensation(job.baseline)
    require_same_arm(session, baseline, Path(job.session))
    measured = measured_of(session)
    found = judge(baseline.model, [measured])
    iso = iso_figures(baseline.model, measured, session.measurements.wanted)
    return content_of(found, baseline.model.chain, [Path(job.session).name], 1e3 * SMALLEST_M, iso)

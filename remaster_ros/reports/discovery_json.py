"""discovery.json: what was found, as other programs read it (format ``remaster-discovery/1``)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.discovery.confirmation import Confirmation
from remaster_ros.discovery.discover import Discovery
from remaster_ros.reports import schemas
from remaster_ros.reports.fit_json import fit_content, read_result, remove_report, table_rows
from remaster_ros.session.files import make_folder, write_atomically
from remaster_ros.version import __version__

DISCOVERY_FILE = 'discovery.json'


def discovery_content(
    discovery: Discovery, confirmation: Confirmation | None = None
) -> schemas.Discovered:
    """Return a discovery as discovery.json has it."""
    fit = fit_content(discovery.fit)
    before, before_std = discovery.offsets_before
    content: dict[str, Any] = {
        'format': schemas.DISCOVERY_FORMAT,
        'version': __version__,
        'robot': fit.robot,
        'session': fit.session,
        'verdict': discovery.verdict,
        'effects': discovery.effects,
        'gain': discovery.gain,
        'metrics': discovery.gain.metrics,
        'noise': {
            'pose_common_fraction': discovery.pose_common_fraction,
            'outliers': [observation for observation, _ in discovery.outliers],
            'heteroscedastic': discovery.noise_by_range,
            'sensors': fit.noise,
        },
        'untestable': discovery.untestable,
        'unexplained': discovery.unexplained,
        'joint_offsets_before': table_rows(
            joint=discovery.fit.joint_names,
            mean_deg=np.degrees(before),
            std_deg=np.degrees(before_std),
        ),
        'joint_offsets_after': fit.joint_offsets,
        'sampler': fit.sampler,
    }
    if discovery.thinning is not None:
        content['rows_searched'] = discovery.thinning
    if confirmation is not None:
        content['confirmation'] = vars(confirmation) | {
            'offsets_rms_sigmas': confirmation.offsets_rms_sigmas,
            'parameters_rms_sigmas': confirmation.parameters_rms_sigmas,
            'effects': [
                {'name': effect.name, 'joints': effect.joints, **vars(cause)}
                for effect, cause in zip(discovery.effects, confirmation.effects, strict=False)
            ],
        }
    return schemas.checked(content, schemas.Discovered)


def save_discovery(
    discovery: Discovery,
    folder: str | os.PathLike[str],
    confirmation: Confirmation | None = None,
    figures: bool = True,
) -> Path:
    """Write discovery.json and, with figures, the report; return what to open.

    Raises
    ------
    InputError
        The folder cannot be written to.
    """
    folder = Path(folder)
    make_folder(folder)
    content = discovery_content(discovery, confirmation)
    write_atomically(folder / DISCOVERY_FILE, schemas.encode(content))
    if not figures:
        remove_report(folder)
        return folder / DISCOVERY_FILE
    # Matplotlib and the templates take a second to import: only where a report is made.
    from remaster_ros.reports.discovery_report import write_discovery_report

    return write_discovery_report(discovery, confirmation, content, folder)


def read_discovery(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read discovery.json and check it against the contract; further keys are kept as they are.

    Raises
    ------
    InputError
        One line naming the file, the key and the remedy.
    """
    return read_result(
        Path(path), schemas.Discovered, schemas.DISCOVERY_FORMAT, DISCOVERY_FILE, 'discover'
    )

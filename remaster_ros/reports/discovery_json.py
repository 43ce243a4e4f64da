"""discovery.json: what was found, as other programs read it (format ``remaster-discovery/1``)."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from remaster_ros.discovery.confirmation import Confirmation
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.errors import InputError
from remaster_ros.reports.fit_json import FIT_LIMIT, REPORT_FILE, fit_to_dict
from remaster_ros.session.files import cannot_write, make_folder, read_limited, write_atomically
from remaster_ros.version import __version__

FORMAT = 'remaster-discovery/1'
DISCOVERY_FILE = 'discovery.json'


class _Parameter(msgspec.Struct):
    name: str
    value: float
    std: float
    unit: str


class _LookAlike(msgspec.Struct):
    name: str
    joints: list[int]
    log_evidence_gain: float
    separate_by: str


class _Effect(msgspec.Struct):
    name: str
    joints: list[int]
    place: str
    driver: str
    form: str
    parameters: list[_Parameter]
    p_value: float
    log_evidence_gain: float
    confusable_with: list[_LookAlike]
    cause: str


class _Gain(msgspec.Struct):
    held_out_rms_before_m: float | None
    held_out_rms_after_m: float | None
    noise_floor_m: float


class _Noise(msgspec.Struct):
    pose_common_fraction: float
    outliers: list[int]
    heteroscedastic: dict[str, Any]


class _Discovery(msgspec.Struct):
    """What the contract asks of discovery.json; further keys may stand beside."""

    format: str
    verdict: Literal['effects', 'none', 'undetermined']
    effects: list[_Effect]
    gain: _Gain
    noise: _Noise
    joint_offsets_after: list[dict[str, Any]]


def discovery_to_dict(
    discovery: Discovery, confirmation: Confirmation | None = None
) -> dict[str, Any]:
    """Return a discovery as discovery.json has it.

    Beyond the contract it holds for each effect ``size_m`` (RMS at the marker after absorption)
    and ``share`` (of the gain, the effects added in their order), ``metrics`` before and after,
    ``untestable`` effects with the reason, ``joint_offsets_before``, with ``--confirm``
    the ``confirmation``, and ``rows_searched`` for a session of which the search saw a part.
    """
    fit = fit_to_dict(discovery.fit)
    before, before_std = discovery.offsets_before
    content: dict[str, Any] = {
        'format': FORMAT,
        'version': __version__,
        'robot': fit['robot'],
        'session': fit['session'],
        'verdict': discovery.verdict,
        'effects': [_effect(effect) for effect in discovery.effects],
        'gain': {
            'held_out_rms_before_m': discovery.gain.held_out_rms_before_m,
            'held_out_rms_after_m': discovery.gain.held_out_rms_after_m,
            'noise_floor_m': discovery.gain.noise_floor_m,
        },
        'metrics': dict(discovery.gain.metrics),
        'noise': {
            'pose_common_fraction': discovery.pose_common_fraction,
            'outliers': [observation for observation, _ in discovery.outliers],
            'heteroscedastic': dict(discovery.noise_by_range),
            'sensors': fit['noise'],
        },
        'untestable': dict(discovery.untestable),
        'joint_offsets_before': [
            {
                'joint': name,
                'mean_deg': float(np.degrees(before[i])),
                'std_deg': float(np.degrees(before_std[i]))
                if np.isfinite(before_std[i])
                else None,
            }
            for i, name in enumerate(discovery.fit.joint_names)
        ],
        'joint_offsets_after': fit['joint_offsets'],
        'sampler': fit['sampler'],
    }
    if discovery.thinning is not None:
        content['rows_searched'] = dataclasses.asdict(discovery.thinning)
    if confirmation is not None:
        content['confirmation'] = {
            'rms_before_m': confirmation.rms_before_m,
            'rms_after_m': confirmation.rms_after_m,
            'rms_own_m': confirmation.rms_own_m,
            'same_offsets': confirmation.same_offsets,
            'carried_over': confirmation.carried_over,
            'confirmed': confirmation.confirmed,
            'effects': [
                {
                    'name': effect.name,
                    'joints': list(effect.joints),
                    'carried_over': _finite(share),
                }
                for effect, share in zip(discovery.effects, confirmation.effects, strict=False)
            ],
        }
    return content


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None


def _effect(effect: FoundEffect) -> dict[str, Any]:
    return {
        'name': effect.name,
        'joints': list(effect.joints),
        'place': effect.place,
        'driver': effect.driver,
        'form': effect.form,
        'parameters': [
            {'name': p.name, 'value': p.value, 'std': p.std, 'unit': p.unit}
            for p in effect.parameters
        ],
        'p_value': effect.p_value,
        'log_evidence_gain': effect.log_evidence_gain,
        'confusable_with': [
            {
                'name': other.name,
                'joints': list(other.joints),
                'log_evidence_gain': other.log_evidence_gain,
                'separate_by': other.separate_by,
            }
            for other in effect.confusable_with
        ],
        'cause': effect.cause,
        'size_m': effect.size_m,
        'share': effect.share,
    }


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
    content = discovery_to_dict(discovery, confirmation)
    encoded = msgspec.json.encode(content)
    # What others rely on is checked before it is written.
    msgspec.json.decode(encoded, type=_Discovery)
    write_atomically(folder / DISCOVERY_FILE, msgspec.json.format(encoded, indent=2) + b'\n')
    if not figures:
        try:
            (folder / REPORT_FILE).unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(folder / REPORT_FILE, error) from None
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
    path = Path(path)
    data = read_limited(path, FIT_LIMIT, 'give the discovery.json that "remaster discover" wrote')
    try:
        content = msgspec.json.decode(data)
        found = msgspec.convert(content, _Discovery)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            f'{path}: {" ".join(str(error).split())}; give a discovery.json of format {FORMAT}'
        ) from None
    if found.format != FORMAT:
        raise InputError(f'{path}: format is {found.format[:60]!r}, not {FORMAT!r}')
    return content

"""fit.json: the result of a fit as other programs read it (format ``remaster-fit/1``)."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from remaster_ros.compensation.export import exports
from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import quaternion_xyzw
from remaster_ros.session.files import cannot_write, make_folder, read_limited, write_atomically
from remaster_ros.types import FloatArray, Session
from remaster_ros.version import __version__

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult

FORMAT = 'remaster-fit/1'
FIT_FILE = 'fit.json'
REPORT_FILE = 'report.html'
APPLY_FOLDER = 'apply'
FIT_LIMIT = 64 * 1024**2


class _JointOffset(msgspec.Struct):
    """One joint's zero-offset; where ``identifiable`` is false, ``why`` says what hides it."""

    joint: str
    mean_deg: float
    std_deg: float
    interval95_deg: tuple[float, float]
    identifiable: bool
    why: str


class _GaugeDirection(msgspec.Struct):
    """A combination of parameters that the data cannot see, and what fixes it."""

    combination: dict[str, float]
    why: str
    fixed_by: str


class _Registration(msgspec.Struct):
    """T_R_N: the sensor's frame N in the robot base R."""

    translation_m: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    std_m: tuple[float, float, float]
    std_rad: tuple[float, float, float]


class _Marker(msgspec.Struct):
    """A marker's position in the tool frame T."""

    position_m: tuple[float, float, float]
    std_m: tuple[float, float, float]


class _Noise(msgspec.Struct):
    """A sensor's noise per axis: of one row, and common to a pose (None: not told apart)."""

    sigma_m: float
    std_m: float
    pose_sigma_m: float | None


class _Sampler(msgspec.Struct):
    """How the posterior was sampled; ``draws`` are kept draws of each chain."""

    name: str
    chains: int
    draws: int
    r_hat_max: float | None
    ess_min: float | None
    seconds: float | None


class _Accuracy(msgspec.Struct):
    """The three metrics by split; ``validation`` is None where nothing was held out."""

    optimization: dict[str, Any] | None
    validation: dict[str, Any] | None


class _LeftOut(msgspec.Struct):
    """A row that was not fitted, and why."""

    observation: int
    why: str


class _Fit(msgspec.Struct):
    """What the contract asks of fit.json."""

    format: str
    joint_offsets: list[_JointOffset]
    gauge: list[_GaugeDirection]
    registration: dict[str, _Registration]
    markers: dict[str, _Marker]
    noise: dict[str, _Noise]
    sampler: _Sampler
    accuracy: _Accuracy
    left_out: list[_LeftOut]


def fit_to_dict(result: FitResult) -> dict[str, Any]:
    """Return a fit as fit.json has it.

    Beyond the contract it holds ``version`` of this program, ``robot`` (name, joints, SHA-256 of
    the URDF), ``session`` (what was measured) and ``parameters`` (every parameter's mean, std and
    convergence, in the units of its name: m and rad), and ``explained_by_noise``: of every sensor
    the mean error after (held out where there are such rows, without the worst twentieth) and what
    the noise makes that the sensor states and that shows within poses (null where neither does).
    """
    session = result.session
    draws = result.draws.reshape(-1, result.draws.shape[-1])
    mean, std = draws.mean(axis=0), draws.std(axis=0, ddof=1)
    sampler = result.sampler
    return {
        'format': FORMAT,
        'version': __version__,
        'robot': {
            'name': result.chain.name,
            'urdf_sha256': session.urdf_sha256,
            'joint_names': list(result.joint_names),
            'base_link': session.base_link,
            'tip_link': session.tip_link,
        },
        'session': _describe(session),
        'joint_offsets': [
            {
                'joint': joint,
                'mean_deg': float(np.degrees(result.joint_offsets[i])),
                'std_deg': float(np.degrees(result.joint_offsets_std[i])),
                'interval95_deg': np.degrees(result.joint_offsets_interval95[i]).tolist(),
                'identifiable': bool(result.identifiable[i]),
                'why': str(result.why[i]),
            }
            for i, joint in enumerate(result.joint_names)
        ],
        'gauge': [
            {
                'combination': {k: float(v) for k, v in direction.combination.items()},
                'why': direction.why,
                'fixed_by': direction.fixed_by,
            }
            for direction in result.gauge
        ],
        'registration': {
            sensor: {
                'translation_m': T_R_N[:3, 3].tolist(),
                'rotation_xyzw': quaternion_xyzw(T_R_N[:3, :3]).tolist(),
                'std_m': result.T_R_N_std_m[sensor].tolist(),
                'std_rad': result.T_R_N_std_rad[sensor].tolist(),
            }
            for sensor, T_R_N in result.T_R_N.items()
        },
        'markers': {
            marker: {
                'position_m': position.tolist(),
                'std_m': result.marker_std_m[marker].tolist(),
            }
            for marker, position in result.marker_positions.items()
        },
        'noise': {
            sensor: {
                'sigma_m': noise.sigma_m,
                'std_m': noise.std_m,
                'pose_sigma_m': noise.pose_sigma_m,
                'pose_std_m': noise.pose_sigma_std_m,
                **{
                    f'{direction}_{key}': value
                    for direction, part in noise.directions.items()
                    for key, value in (
                        ('sigma_m', part.sigma_m),
                        ('std_m', part.std_m),
                        ('pose_sigma_m', part.pose_sigma_m),
                        ('pose_std_m', part.pose_sigma_std_m),
                    )
                },
            }
            for sensor, noise in result.noise.items()
        },
        'sampler': {
            'name': sampler.name,
            'chains': int(sampler.chains),
            'draws': int(sampler.draws),
            'r_hat_max': _finite(np.max(sampler.r_hat)),
            'ess_min': _finite(np.min(np.minimum(sampler.ess_bulk, sampler.ess_tail))),
            'seconds': _finite(sampler.seconds),
            'acceptance_rate': _finite(sampler.acceptance_rate),
            'converged': bool(sampler.converged),
            'message': sampler.message,
            'precision': _finite(sampler.precision),
            'precision_wanted': sampler.precision_wanted,
            'log_density_error_max': _finite(sampler.log_density_error),
            'log_density_checked_draws': int(sampler.checked),
        },
        'parameters': [
            {
                'name': name,
                'mean': float(mean[i]),
                'std': float(std[i]),
                'r_hat': _finite(sampler.r_hat[i]),
                'ess_bulk': _finite(sampler.ess_bulk[i]),
                'ess_tail': _finite(sampler.ess_tail[i]),
            }
            for i, name in enumerate(result.parameter_names)
        ],
        'accuracy': dict(result.accuracy),
        'left_out': [
            {'observation': int(observation), 'why': why} for observation, why in result.left_out
        ],
        'explained_by_noise': {
            check.sensor: {
                'explained': check.explained,
                'after_m': check.error_m,
                'noise_m': check.noise_error_m,
                'stated_std_m': check.stated_m,
                'within_pose_std_m': check.within_m,
            }
            for check in result.noise_checks
        },
    }


def write_fit(result: FitResult, path: str | os.PathLike[str]) -> dict[str, Any]:
    """Write fit.json in one step and return its content.

    Raises
    ------
    InputError
        The folder cannot be written to.
    """
    path = Path(path)
    content = fit_to_dict(result)
    make_folder(path.parent)
    write_atomically(path, msgspec.json.format(msgspec.json.encode(content), indent=2) + b'\n')
    return content


def read_fit(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read fit.json and check it against the contract; further keys are kept as they are.

    Raises
    ------
    InputError
        One line naming the file, the key and the remedy.
    """
    path = Path(path)
    data = read_limited(path, FIT_LIMIT, 'give the fit.json that "remaster fit" wrote')
    try:
        content = msgspec.json.decode(data)
        fit = msgspec.convert(content, _Fit)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            f'{path}: {" ".join(str(error).split())}; give a fit.json of format {FORMAT}'
        ) from None
    if fit.format != FORMAT:
        raise InputError(f'{path}: format is {fit.format[:60]!r}, not {FORMAT!r}; fit again')
    return content


def joint_offsets_rad(
    fit: dict[str, Any], joint_names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return the offsets of a fit.json in the order of a robot's joints, and how sure they are.

    Returns
    -------
    offsets, std
        rad, (k,) each; the std of a joint that the data could not tell is 0.

    Raises
    ------
    InputError
        The offsets are for other joints, or are no angles.
    """
    rows = {row['joint']: row for row in fit['joint_offsets']}
    if set(rows) != set(joint_names) or len(rows) < len(fit['joint_offsets']):
        raise InputError(
            f'the offsets are for the joints {", ".join(rows)}, '
            f'the robot has {", ".join(joint_names)}; use the fit of this robot'
        )
    ordered = [rows[name] for name in joint_names]
    for row in ordered:
        for key, low in (('mean_deg', -360.0), ('std_deg', 0.0)):
            if not low <= row[key] <= 360.0:
                raise InputError(
                    f'{row["joint"]}: {key} is {row[key]:g}, not {low:g} to 360; fit again'
                )
    std = [row['std_deg'] if row['identifiable'] else 0.0 for row in ordered]
    return np.radians([row['mean_deg'] for row in ordered]), np.radians(std)


def prepare_folder(folder: str | os.PathLike[str]) -> None:
    """Create the folder for results and make sure that files can be written there.

    Raises
    ------
    InputError
        They cannot; said before the long work, not after it.
    """
    folder = Path(folder)
    make_folder(folder)
    try:
        # A file without a name: an interrupt leaves nothing behind.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise cannot_write(folder, error) from None


def save_fit(result: FitResult, folder: str | os.PathLike[str], figures: bool = True) -> Path:
    """Write fit.json, the files to apply the offsets, and the report with its figures.

    Without figures there is no report; that of an earlier fit in the folder would contradict
    fit.json and is removed.

    Returns
    -------
    Path
        The report; fit.json without figures.

    Raises
    ------
    InputError
        The folder cannot be written to.
    """
    folder = Path(folder)
    write_fit(result, folder / FIT_FILE)
    make_folder(folder / APPLY_FOLDER)
    for name, text in exports(result).items():
        write_atomically(folder / APPLY_FOLDER / name, text)
    if not figures:
        try:
            (folder / REPORT_FILE).unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(folder / REPORT_FILE, error) from None
        return folder / FIT_FILE
    # Matplotlib and the templates take a second to import: only where a report is made.
    from remaster_ros.reports.report import write_report

    return write_report(result, folder)


def _describe(session: Session) -> dict[str, Any]:
    m = session.measurements
    counts = {}
    for split, rows in (('optimization', ~m.is_validation), ('validation', m.is_validation)):
        counts[split] = {
            'observations': int(rows.sum()),
            'configurations': len(np.unique(m.configuration[rows])),
            'poses': len(np.unique(m.pose[rows])),
        }
    return {
        **counts,
        'sensors': dict(session.sensors),
        'created': session.created,
        'exit_status': session.exit_status,
    }


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None

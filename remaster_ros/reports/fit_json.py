# SPDX-License-Identifier: Apache-2.0
"""Content of fit.json (format ``remaster-fit/1``)."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from msgspec import UNSET, structs

from remaster_ros.calibration.records import Robot
from remaster_ros.compensation.export import APPLY_FOLDER, MODEL_FILE
from remaster_ros.discovery.geometry_model import GeometryModel
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import quaternion_xyzw
from remaster_ros.reports import schemas
from remaster_ros.reports.fit_judgement import verdict
from remaster_ros.reports.loadable import geometry_of, uncertainty
from remaster_ros.reports.rows_csv import RESIDUALS_FILE
from remaster_ros.session.files import read_limited
from remaster_ros.session.json_records import Record, checked, decoded, format_of
from remaster_ros.types import FloatArray, Session
from remaster_ros.version import __version__

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult, Orientations

FIT_FILE = 'fit.json'
REPORT_FILE = 'report.html'
DISCOVERY_FILE = 'discovery.json'
FORMATS = {FIT_FILE: schemas.FIT_FORMAT, DISCOVERY_FILE: schemas.DISCOVERY_FORMAT}
# Files that the commands write in addition to their result.
WRITTEN = (REPORT_FILE, APPLY_FOLDER, 'figures', 'predictions.csv', RESIDUALS_FILE)
FIT_LIMIT = 64 * 1024**2


def estimates(result: FitResult) -> dict[str, Any]:
    """Return the estimates of a fit as fit.json and discovery.json have them, not yet checked.

    Keys: robot, session, joint_offsets, registration, markers, noise, sampler.
    """
    session = result.session
    limits = {'std_is_lower_limit': True} if result.other_errors else {}
    return {
        'robot': Robot.of(session, result.chain),
        'session': _describe(session),
        'joint_offsets': _offsets(result),
        'registration': {
            sensor: {
                'translation_m': T_R_N[:3, 3],
                'rotation_xyzw': quaternion_xyzw(T_R_N[:3, :3]),
                'std_m': result.T_R_N_std_m[sensor],
                'std_rad': result.T_R_N_std_rad[sensor],
                **limits,
            }
            for sensor, T_R_N in result.T_R_N.items()
        },
        'markers': {
            name: {'position_m': position, 'std_m': result.marker_std_m[name], **limits}
            for name, position in result.marker_positions.items()
        },
        'noise': result.noise,
        'sampler': result.sampler,
    }


def _offsets(result: FitResult) -> list[dict[str, Any]]:
    """Rows of joint_offsets, in joint order: name, identifiable, why, mean, std, interval95."""
    rows = table_rows(joint=result.joint_names, identifiable=result.identifiable, why=result.why)
    values = of_joints(
        result.chain,
        mean=result.joint_offsets,
        std=result.joint_offsets_std,
        interval95=result.joint_offsets_interval95,
    )
    return [{**row, **value} for row, value in zip(rows, values, strict=True)]


def of_joints(chain: SerialChain, **columns: FloatArray) -> list[dict[str, Any]]:
    """Return a row for each joint of values in rad or m, (k, ...), converted to degrees or mm.

    ``columns``: values by name. A column x becomes x_deg; for a prismatic joint x_mm, with
    x_deg None. Each row has its ``unit``, too.
    """
    rows = []
    for joint, (unit, scale) in enumerate(zip(chain.shown_units, chain.shown_scale)):
        row: dict[str, Any] = {'unit': unit, **{f'{name}_deg': None for name in columns}}
        row |= {f'{name}_{unit}': scale * values[joint] for name, values in columns.items()}
        rows.append(row)
    return rows


def _geometry(result: FitResult, geometry: GeometryModel) -> dict[str, Any]:
    """Return the content of the key geometry of fit.json, on link lengths and axis tilts.

    With the length or tilt that changes each identifiable offset most.
    """

    def std_mm(name: str) -> float | None:
        """RMS displacement by the lengths or tilts, mm; None if the fit has none."""
        stds = [
            std
            for candidate, std in zip(geometry.members, geometry.std_m, strict=True)
            if candidate.name == name
        ]
        return 1e3 * float(stds[0]) if stds else None

    imitations = []
    for index in np.flatnonzero(result.identifiable):
        member, moved = geometry.largest_imitation(int(index))
        imitations.append(
            {
                'joint': result.joint_names[index],
                'cause': member.name,
                'of': member.joints[0],
                'axis': member.variant,
                'deg': None,
                result.chain.shown_units[index]: float(result.chain.shown_scale[index] * moved),
            }
        )
    return {
        'tolerance_mm': 1e3 * geometry.tolerance_m,
        'length_std_mm': std_mm('link_length'),
        'tilt_std_mm': std_mm('joint_axis_tilt'),
        'drawing_held_out_mean_mm': 1e3 * geometry.drawing_held_out_m,
        'held_out_mean_mm': 1e3 * geometry.held_out_m,
        'file': f'{APPLY_FOLDER}/{MODEL_FILE}' if geometry.is_better else '',
        'imitations': imitations,
    }


def _orientation(result: FitResult, found: Orientations) -> dict[str, Any]:
    """Content of the key orientation of fit.json, in degrees, or the reason if none is fitted."""
    information = found.information
    return {
        'fitted': not found.why_not,
        'count': found.count,
        'why': found.why_not,
        'noise': {
            sensor: {
                'sigma_deg': np.degrees(noise.sigma_m),
                'std_deg': np.degrees(noise.std_m),
                'pose_sigma_deg': (
                    None if noise.pose_sigma_m is None else np.degrees(noise.pose_sigma_m)
                ),
            }
            for sensor, noise in found.noise.items()
        },
        'bodies': {
            name: {
                'rotation_xyzw': quaternion_xyzw(R_T_B),
                'std_deg': np.degrees(found.std_rad[name]),
            }
            for name, R_T_B in found.R_T_B.items()
        },
        'p_value': None if information is None else information.p_value,
        **_by_positions(result),
    }


def _by_positions(result: FitResult) -> dict[str, dict[str, float | None]]:
    """Return the std of each identifiable offset from measured positions alone, deg or mm.

    {'std_positions_deg': {joint: std}}, and 'std_positions_mm' for prismatic joints; a std is
    None if infinite. If the fit used no orientations, {'std_positions_deg': {}}.
    """
    found: dict[str, dict[str, float | None]] = {'std_positions_deg': {}}
    information = None if result.orientations is None else result.orientations.information
    if information is None:
        return found
    for joint in np.flatnonzero(result.identifiable).tolist():
        std = float(result.chain.shown_scale[joint] * information.std_without[joint])
        by_joint = found.setdefault(f'std_positions_{result.chain.shown_units[joint]}', {})
        by_joint[result.joint_names[joint]] = std if np.isfinite(std) else None
    return found


def fit_content(result: FitResult) -> schemas.Fit:
    """Return the content of fit.json, checked against its schema; keys without a value are unset.

    The std of sampled parameters has n - 1 in its denominator. The std of an offset also includes
    errors that remain after the fit beyond noise, and deviations of link lengths and axis tilts
    from the drawing.
    """
    draws = result.draws.reshape(-1, result.draws.shape[-1])
    content: dict[str, Any] = {
        'format': schemas.FIT_FORMAT,
        'version': __version__,
        **estimates(result),
        'gauge': result.gauge,
        'parameters': table_rows(
            name=result.parameter_names,
            mean=draws.mean(axis=0),
            std=draws.std(axis=0, ddof=1),
            **result.diagnostics._asdict(),
        ),
        'accuracy': result.accuracy,
        'left_out': [{'observation': row, 'why': why} for row, why in result.left_out],
        'judgement': msgspec.to_builtins(verdict(result)),
        'explained_by_noise': {check.sensor: check for check in result.noise_checks},
    }
    if result.structure is not None:
        content['residual_structure'] = [
            structs.replace(test, found=test in result.structure.found)
            for test in result.structure.tests
        ]
        content['intervals'] = 'robust' if result.other_errors else 'model'
        model = result.joint_offsets_std / result.widening
        shown = result.chain.shown_scale * model
        for row, std, times in zip(content['joint_offsets'], shown, result.widening, strict=True):
            if times > 1.0:
                row[f'model_std_{row["unit"]}'] = std
    if result.orientations is not None:
        content['orientation'] = _orientation(result, result.orientations)
    if result.clocks:
        content['clocks'] = clocks_content(result.clocks)
    if result.motion_proof is not None:
        content['motion_proof'] = result.motion_proof
    if (geometry := geometry_of(result)) is not None:
        content['geometry'] = _geometry(result, geometry)
        wider = of_joints(result.chain, **uncertainty(result)._asdict())
        for row, off_drawing in zip(content['joint_offsets'], wider, strict=True):
            if row['identifiable']:
                row[f'std_if_exactly_drawn_{row["unit"]}'] = row[f'std_{row["unit"]}']
                row |= off_drawing
    return checked(content, schemas.Fit)


def clocks_content(clocks: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
    """Return the delays of the sensors' stamps as files have them, in ms.

    ``clocks``: delay and its standard deviation by sensor, s.
    """
    return {
        name: {'late_ms': 1e3 * late, 'std_ms': 1e3 * std} for name, (late, std) in clocks.items()
    }


def table_rows(**columns: Iterable[Any]) -> list[dict[str, Any]]:
    """Return columns of equal length as rows, dicts by column name.

    Raises ValueError if the columns differ in length.
    """
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _describe(session: Session) -> dict[str, Any]:
    """Return the content of the key session: counts by split, sensors, and origin of a session."""
    m = session.measurements
    counts = {
        name: {
            'observations': rows.sum(),
            'configurations': len(np.unique(m.configuration[rows])),
            'poses': len(np.unique(m.pose[rows])),
        }
        for name, rows in (('optimization', ~m.is_validation), ('validation', m.is_validation))
    }
    return {
        **counts,
        'sensors': session.sensors,
        'created': session.created,
        'exit_status': session.exit_status,
        **({} if session.timed else {'times': 'none'}),
        **({'observations_sha256': digest} if (digest := session.observations_sha256) else {}),
    }


def read_fit(path: str | os.PathLike[str]) -> schemas.Fit:
    """Read fit.json and check it against its schema; unknown keys are dropped.

    Raises
    ------
    InputError
        One line naming the file, the key and the remedy.
    """
    return read_result(Path(path), schemas.Fit, schemas.FIT_FORMAT, FIT_FILE, 'fit')


def read_result(path: Path, schema: type[Record], form: str, name: str, verb: str) -> Record:
    """Read the file ``name`` that the command ``verb`` wrote, as an object of the schema.

    ``form``: its format. Raises InputError if it is missing, damaged, of another format, or
    lacks a key.
    """
    data = read_limited(path, FIT_LIMIT, f'give the {name} that "remaster {verb}" wrote')
    return decoded(data, path, schema, form, f'give a {name} of format {form}')


def joint_offsets_of(fit: schemas.Fit, chain: SerialChain) -> tuple[FloatArray, FloatArray]:
    """Offsets of a fit.json in the order of a robot's joints, with their standard deviations.

    Returns
    -------
    offsets, std
        rad, m for prismatic joints, (k,) each; the std is that for an arm of exactly nominal
        geometry, as predictions use it, and 0 for offsets that are not identifiable.

    Raises
    ------
    InputError
        The offsets are for other joints, in another unit, missing, or larger than a whole turn.
    """
    rows = {row.joint: row for row in fit.joint_offsets}
    joint_names = chain.joint_names
    if set(rows) != set(joint_names) or len(rows) < len(fit.joint_offsets):
        raise InputError(
            f'the offsets are for the joints {", ".join(rows)}, '
            f'the robot has {", ".join(joint_names)}; use the fit of this robot'
        )
    ordered = [rows[name] for name in joint_names]
    most = 2.0 * np.pi * chain.per_radian * chain.shown_scale
    for row, unit, high in zip(ordered, chain.shown_units, most.round().tolist(), strict=True):
        if row.unit != unit or getattr(row, f'mean_{unit}') in (None, UNSET):
            raise InputError(
                f'{row.joint}: its offset is in {row.unit}, the robot has it in {unit}; use the '
                'fit of this robot'
            )
        limits = {f'mean_{unit}': -high, f'std_{unit}': 0.0}
        if getattr(row, drawn := f'std_if_exactly_drawn_{unit}') is not UNSET:
            limits[drawn] = 0.0
        for key, low in limits.items():
            value = getattr(row, key)
            if value in (None, UNSET):
                raise InputError(f'{row.joint}: {key} is missing; fit again')
            if not low <= value <= high:
                raise InputError(
                    f'{row.joint}: {key} is {value:g}, not {low:g} to {high:g}; fit again'
                )
    means, stds = np.array([(row.mean_and_std[0], row.std_if_exactly_drawn) for row in ordered]).T
    return means, np.where([row.identifiable for row in ordered], stds, 0.0)


def require_own(path: Path, format_: str) -> None:
    """Raise InputError if a file to be replaced is unreadable or no JSON file of this format."""
    if format_of(read_limited(path, FIT_LIMIT, 'it was there')) != format_:
        raise InputError(f'{path}: is there and is no {format_}; it is not replaced, name another')

# SPDX-License-Identifier: Apache-2.0
"""Errors of a session with a file that a robot can load, computed with that very file.

The figure of a result is then that of the written file: without the offsets that are not applied,
with the base and the marker that belong to the file, and without anything that the file has no
place for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from remaster_ros.calibration.comparison import predicted_rows
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.result import FitResult
from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import FloatArray, Measurements, Session


def errors_with_urdf(session: Session, urdf: str, gross: Sequence[int] = ()) -> FloatArray:
    """Errors (measured minus modelled) of all rows with the arm of a URDF, m, (n, 3).

    Along the axes of each row's sensor. Sensor poses and markers are fitted to the rows of the
    split 'optimization', without those whose ``observation`` is in ``gross``; zero-offsets are
    those of the URDF alone. ``urdf``: its text. Raises as `estimate`.
    """
    session = replace(session, urdf=urdf)
    m = session.measurements
    kept = np.flatnonzero(~np.isin(m.observation, gross) | m.is_validation)
    found = estimate(Problem.of(replace(session, measurements=m.select(kept))))
    predicted = predicted_rows(Problem.of(session), found.model, found.before.z)
    return np.asarray(m.position - predicted)


def errors_with_correction(model: ArmModel, measurements: Measurements) -> FloatArray:
    """Errors (measured minus modelled) of all rows if the arm were corrected, m, (n, 3).

    In the sensors' frames, with the model of a compensation.json. They contain the errors that
    a command leaves near singularities; nothing is fitted. ``measurements``: their indices of
    sensors and markers count those of the model, in its order; rows without a temperature
    count as at the reference temperature.
    """
    m = measurements
    known = np.isfinite(m.temperature_c)
    warm = np.where(known, m.temperature_c, model.reference_c)
    command = Compensator(model).command(m.q, warm)
    reached, wanted = model.state(command, warm).tool, model.chain.forward(m.q)
    markers = np.stack(list(model.markers.values()))[m.marker]
    frames = np.stack(list(model.T_R_N.values()))[m.sensor]
    there = apply(model.state(m.q, warm).tool, markers)
    command_error = apply(reached, markers) - apply(wanted, markers)
    # From R to each row's sensor.
    seen = np.einsum('nji,nj->ni', frames[:, :3, :3], there - command_error - frames[:, :3, 3])
    return np.asarray(m.position - seen)


def without_errors_of_measuring(fit: FitResult, parameters: slice | FloatArray) -> FloatArray:
    """Measured positions of all rows without the effect of some parameters of a fit, m, (n, 3).

    ``parameters``: slice or mask among the fit's further parameters (those after offsets,
    registrations and markers), meant for those of sensor errors. The measured positions
    themselves are returned if these parameters are all 0 or there are none.
    """
    measured = fit.session.measurements.position
    model, after = fit.predictive.model, fit.predictive.after
    z = after.copy()
    z[model.core :][parameters] = 0.0
    if fit.found is None or np.array_equal(z, after):
        return measured
    prediction, less = (predicted_rows(fit.found.problem, model, at) for at in (after, z))
    return np.asarray(measured - (prediction - less))

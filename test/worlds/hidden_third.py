# SPDX-License-Identifier: Apache-2.0
"""A third set of poses, seen by neither fit nor guard: does the model that was returned do harm?

The same arm goes on another tour during the same time. Its errors are against what the sensors
would see there without noise: what they leave is the model's fault alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from worlds.hidden_world import HiddenWorld, Visits

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.extension import Term
from remaster_ros.calibration.predictions import Predictions, predict
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.effects.context import Context, PartOfContext
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.reports.discovery_json import predictions_of
from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.types import FloatArray, Session

# A model whose error is so many times that of the offsets alone does harm.
HARM = 1.05


@dataclass(frozen=True)
class ThirdErrors:
    """RMS of the 3-D error on the third set, m: with the offsets only, with what was returned."""

    offsets_m: float
    returned_m: float

    @property
    def harm(self) -> bool:
        """Whether what was returned is worse by more than 5 %."""
        return self.returned_m > HARM * self.offsets_m


def third_errors(
    world: HiddenWorld, effects: tuple[HiddenEffect, ...], visits: Visits, found: Discovery
) -> ThirdErrors:
    """Predict a third set with what was found in a session of this world, and without causes."""
    third = world.on(visits).without_noise(effects)

    def rms(predicted: FloatArray) -> float:
        errors = third.measurements.position - predicted
        return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))

    return ThirdErrors(
        rms(predicted_by_offsets(found.fit.session, third)), rms(predicted_by(found, third))
    )


def predicted_by_offsets(session: Session, third: Session) -> FloatArray:
    """Return where a fit of registration, offsets and markers expects other rows, m, (n, 3)."""
    found = estimate(Problem.of(session))
    model, x = found.model, found.model.natural(found.mode.z)
    rows = third.measurements
    points = found.problem.chain.positions(rows.q, model.markers(x)[rows.marker], model.offsets(x))
    return apply(inverse(model.T_R_N(x))[rows.sensor], points)


def predicted_by(found: Discovery, third: Session) -> FloatArray:
    """Return where the model that was returned expects the rows of another session, m, (n, 3).

    Sensors and markers are those of the discovery's session, in that order.
    """
    return predictions_elsewhere(found, third).position


def predictions_elsewhere(found: Discovery, third: Session) -> Predictions:
    """Predict the rows of another session with their 95 % regions; see `predicted_by`."""
    fit, context = found.fit, _Elsewhere.of(found.residuals.context, third)
    model = fit.predictive.model
    if model.extension is not None:
        terms, displacement0 = [], np.zeros((len(third.measurements), 3))
        # By their place: two cells without a name may call their parameters alike.
        solution = found.solution
        named = {name for group in found.groups for member in group for name in member.parameters}
        for candidate, where in zip(solution.candidates, solution.slices(), strict=True):
            if (
                candidate.driver == 'time'
                and candidate.of_measurement
                and not named & {*candidate.parameters}
            ):
                # Errors that follow each other belong to the readings, not to the poses; a drift
                # without a name beside a wander is a part of it.
                continue
            columns = candidate.columns(context)
            terms.append(Term(where, columns.at, columns.values))
            if columns.at is None:
                displacement0 += columns.values @ model.extension.theta0[where]
        model = replace(
            model,
            extension=replace(model.extension, terms=tuple(terms), displacement0=displacement0),
        )
        fit = replace(fit, predictive=replace(fit.predictive, model=model))
    # The factor is that of the rows to fit: None would determine another with these rows.
    widening = predictions_of(found).widening
    return predict(fit, third.measurements, widening)


@dataclass(frozen=True, eq=False)
class _Elsewhere(PartOfContext):
    """Rows of another session where a cell's zero of time, temperature, place is the first's."""

    @classmethod
    def of(cls, context: Context, third: Session) -> _Elsewhere:
        return cls(
            context.chain,
            third.measurements,
            context.sensor_names,
            context.marker_names,
            context.joint_offsets,
            context.markers,
            context.T_R_N,
            context,
            np.arange(0),
        )

    @cached_property
    def approach(self) -> FloatArray:
        return Context.approach.func(self)  # type: ignore[attr-defined, no-any-return]

    def lagging_warming(self, lag_s: float) -> FloatArray:
        return Context.lagging_warming(self, lag_s)

    @cached_property
    def elapsed_s(self) -> FloatArray:
        return self.measurements.stamp_s - self.whole.measurements.stamp_s.min()

    @cached_property
    def progress(self) -> FloatArray:
        return Context.progress.func(self)  # type: ignore[attr-defined, no-any-return]

    @cached_property
    def warming(self) -> FloatArray:
        given = self.whole.measurements.temperature_c
        known = np.flatnonzero(np.isfinite(given))
        if len(known) == 0:
            return np.zeros(len(self))
        first = given[known[np.argmin(self.whole.measurements.stamp_s[known])]]
        return self.measurements.temperature_c - first

"""Errors that follow the place in front of a sensor, too weak to stand out in the search.

There a field over a sensor's volume has to beat the best of all that is tried. Here the place
alone is asked for, one F test a sensor: do polynomials of the place up to the second degree
explain more of the means of the poses than noise would, beside registrations, offsets, markers
and the causes found? Half a lens that is bent, too little for a cause of its own, shows so.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from remaster_ros.calibration.gauge_words import the
from remaster_ros.calibration.residual_structure import LEAST_NOISE_M, explained_of_poses
from remaster_ros.calibration.smooth_functions import of_position
from remaster_ros.discovery.effects.sensor_field import EFFECT as SENSOR_FIELD
from remaster_ros.discovery.guard import Unexplained
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution


def errors_by_place(
    data: Residuals, solution: Solution, significance: float
) -> Iterator[Unexplained]:
    """Give an entry for each sensor whose errors follow the place, with no field of its own.

    Parameters
    ----------
    data, solution
        What the search worked on and found.
    significance
        Of the test of one sensor.
    """
    rows, cells = data.rows, solution.cells
    parts = [data.base, data.columns(cells), data.errors[:, :, None], of_position(rows)]
    white = data.noise_model.whitened(np.concatenate(parts, axis=2), solution.noise)
    fitted = parts[0].shape[2] + parts[1].shape[2]
    model, errors, places = np.split(white, [fitted, fitted + 1], axis=2)
    left = rows.group_sum(data.left(solution)) / rows.group_size[:, None]
    noise_m = data.noise_model.sensor_noise(solution.noise).total
    located = {cell.subject for cell in cells if cell.name == SENSOR_FIELD.name}
    families = np.split(places, len(rows.spans), axis=2)
    for (sensor, _), family in zip(rows.spans, families, strict=True):
        name = data.context.sensor_names[sensor]
        if name in located or noise_m[sensor] < LEAST_NOISE_M:
            continue
        found = explained_of_poses(rows, model, family, errors[:, :, 0])
        if found is None or found.p_value > significance:
            continue
        mean_square = np.mean(np.sum(left[rows.group_sensor == sensor] ** 2, axis=1))
        size_m = float(np.sqrt(found.share * mean_square))
        yield Unexplained(
            where='sensor_frame',
            driver='position',
            size_m=size_m,
            p_value=found.p_value,
            next=(
                f'From pose to pose the errors follow the place in front of {the("sensor", name)} '
                f'more than chance would ({1e3 * size_m:.3f} mm RMS), but no cause stands out '
                'from all that were tried. Measure the same poses with the sensor moved and '
                'turned: what follows its volume is its own; or measure more poses.'
            ),
        )

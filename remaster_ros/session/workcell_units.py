"""What a cell file's numbers say of their units: millimetres for metres, radians for degrees."""

from __future__ import annotations

from collections.abc import Iterator
from math import degrees, pi
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from remaster_ros.session.workcell import Workcell

# Nobody places a marker worse than this; a session whose nominal places say nothing may say so.
LARGEST_MARKER_STD_M = 0.02
# No arm or tool of those that this is for reaches so far.
LARGEST_REACH_M = 10.0
LARGEST_TOOL_M = 3.0
FARTHEST_SENSOR_M = 200.0
LARGEST_LINK_RADIUS_M = 1.0
# A retroreflector or sphere is seen from further round than this.
SMALLEST_VIEW_DEG = 3.5


def unit_problem(cell: Workcell) -> str:
    """Return what is wrong with the first number that cannot be in its unit; '' where none is."""
    if cell.marker_std_m > LARGEST_MARKER_STD_M:
        return (
            f'marker_std_m is {cell.marker_std_m:g}, which is {1e3 * cell.marker_std_m:g} mm: how '
            f'well the markers are placed, in metres, at most {LARGEST_MARKER_STD_M:g}; if '
            f'millimetres were meant, write {cell.marker_std_m:g}e-3'
        )
    for key, value, most in _lengths(cell):
        if abs(value) > most:
            return (
                f'{key} has {value:g} m, beyond {most:g} m; if millimetres were meant, write '
                f'{value / 1e3:g}'
            )
    for key in ('azimuth_deg', 'roll_deg', 'radius_m', 'height_m'):
        low, high = getattr(cell.poses, key)
        if low > high:
            return f'poses.{key} goes from {low:g} down to {high:g}; give the smaller one first'
    if cell.poses.radius_m[0] < 0.0:
        return f'poses.radius_m begins at {cell.poses.radius_m[0]:g}; it must not be negative'
    for key in ('azimuth_deg', 'roll_deg'):
        low, high = getattr(cell.poses, key)
        if low < high and max(abs(low), abs(high)) < 2.0 * pi + 0.01:
            return (
                f'poses.{key} is {low:g} to {high:g}, a range of {high - low:.3g} degrees; if '
                f'radians were meant, write {degrees(low):.4g}, {degrees(high):.4g}'
            )
    for name, sensor in cell.sensors.items():
        if not SMALLEST_VIEW_DEG <= sensor.max_angle_deg <= 180.0:
            return (
                f'sensors.{name}.max_angle_deg is {sensor.max_angle_deg:g}; it must be from '
                f'{SMALLEST_VIEW_DEG:g} to 180 degrees (radians would be '
                f'{degrees(sensor.max_angle_deg):.4g} degrees)'
            )
    return ''


def _lengths(cell: Workcell) -> Iterator[tuple[str, float, float]]:
    """Return key, value and largest value, m, of every length."""
    for name, position in cell.markers.items():
        for value in position:
            yield f'markers.{name}', value, LARGEST_TOOL_M
    for name, sensor in cell.sensors.items():
        for value in sensor.rough_position_m:
            yield f'sensors.{name}.rough_position_m', value, FARTHEST_SENSOR_M
    for key in ('radius_m', 'height_m'):
        for value in getattr(cell.poses, key):
            yield f'poses.{key}', value, LARGEST_REACH_M
    yield 'link_radius_m', cell.link_radius_m, LARGEST_LINK_RADIUS_M

# SPDX-License-Identifier: Apache-2.0
"""Parameters: a frozen dataclass, each field with unit, range and description; no ROS.

Nodes declare such a class to ROS (`remaster_ros.nodes.parameters`); a sensor's driver has one of
its own, which is also checked where the driver is used without a node.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from remaster_ros.errors import InputError


def parameter(
    default: Any,
    description: str,
    *,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    off: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """Return a dataclass field that describes a node parameter.

    Parameters
    ----------
    default
        Value if the user gives none; its type is the parameter's type.
    description, unit
        For the user; shown by ``ros2 param describe``.
    low, high
        Smallest and largest allowed value, both included; None for no limit.
    off
        Further allowed value, outside of this range, that switches off what the parameter limits;
        None if there is none.
    choices
        Allowed words of a text parameter; () if any text is allowed.
    live
        Whether it can be changed while the node runs, if the node has an `on_change`.
    """
    metadata = {
        'description': description,
        'unit': unit,
        'low': low,
        'high': high,
        'off': off,
        'choices': choices,
        'live': live,
    }
    return dataclasses.field(default=default, metadata=metadata)


def parameter_fields(kind: Any) -> dict[str, dataclasses.Field[Any]]:
    """Return the fields of a dataclass or its instance that were made by `parameter`, by name."""
    return {field.name: field for field in dataclasses.fields(kind) if field.metadata}


def check(owner: str, field: dataclasses.Field[Any], value: Any) -> Any:
    """Return a parameter's value if it is valid; an int is converted for a float, nothing else.

    Parameters
    ----------
    owner
        Name of the node or driver that has the parameter, for the message.
    field
        Made by `parameter`.
    value
        The value to check.

    Raises
    ------
    InputError
        The value is of another type, out of range or none of the choices; one line.
    """
    where = f'{owner}: parameter {field.name}'
    wanted = type(field.default)
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not wanted:
        raise InputError(f'{where} is {value!r}; it must be of type {wanted.__name__}')
    low, high, off = (field.metadata[key] for key in ('low', 'high', 'off'))
    too_low = low is not None and not value >= low
    too_high = high is not None and not value <= high
    if (too_low or too_high) and not (off is not None and value == off):
        unit = f' {field.metadata["unit"]}' if field.metadata['unit'] else ''
        limits = f'{"-inf" if low is None else low} to {"inf" if high is None else high}'
        none = '' if off is None else f', or be {off:g} for no such limit'
        raise InputError(f'{where} is {value}; it must lie in {limits}{unit}{none}')
    choices = field.metadata['choices']
    if choices and value not in choices:
        raise InputError(f'{where} is {value!r}; it must be one of {", ".join(choices)}')
    return value


def check_all(owner: str, values: Any) -> None:
    """Check every field of ``values``, an instance, that was made by `parameter`.

    Nothing is changed or converted. ``owner``: name of the node or driver that has the
    parameters, for the message. Raises InputError, which names owner and field, for the first
    value of another type, out of range, or none of the choices.
    """
    for name, field in parameter_fields(values).items():
        check(owner, field, getattr(values, name))


@dataclasses.dataclass(frozen=True)
class SimulationParameters:
    """Base of the parameters of nodes whose watchdogs follow the clock of a simulation."""

    simulated_clock_rate: float = parameter(
        0.0,
        'in a simulation that waits for its nodes, how many times as fast as the wall clock its '
        'time runs: watchdogs then follow it; 0: they follow the wall clock',
        low=0.0,
        high=100.0,
    )

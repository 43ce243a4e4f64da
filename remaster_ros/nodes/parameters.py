# SPDX-License-Identifier: Apache-2.0
"""A node's parameters: one frozen dataclass, each field with unit, range and description.

A value of the wrong type, outside its range, or the name of no parameter is refused at
start with one line. While the node runs, what is declared `live` can be changed, with the same
checks; everything else is read-only, `use_sim_time` as well: what was answered "successful" and
changed nothing would be believed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node

from remaster_ros.errors import InputError
from remaster_ros.nodes.running import RemasterNode, fault_of_this_program
from remaster_ros.parameters import check, parameter, parameter_fields

__all__ = ['check', 'declare', 'parameter']

T = TypeVar('T')

# Declared by rclpy itself, or by every node.
_ALWAYS = ('use_sim_time', 'start_type_description_service')


def declare(node: Node, kind: type[T], on_change: Callable[[T], None] | None = None) -> T:
    """Declare the fields of `kind` as parameters of `node`; return an instance with their values.

    ``on_change``: called with all parameters when some are set while the node runs, in an
    executor's thread; the new ones hold from its return on. If it raises InputError, the
    change is refused, with its text as the reason. Only fields declared `live` can be set so;
    the others are read-only, and all are if ``on_change`` is None.

    Raises InputError for an unknown parameter or an invalid value; it names the node, the
    parameter and what is allowed.
    """
    overrides: Mapping[str, Any] = node._parameter_overrides
    fields = parameter_fields(kind)
    for name in overrides:
        if name not in fields and name not in _ALWAYS and not name.startswith('qos_overrides.'):
            known = ', '.join(sorted(fields))
            raise InputError(
                f'{node.get_name()}: unknown parameter {name!r}; the parameters are {known}'
            )
    values = {}
    for name, field in fields.items():
        value = overrides[name].value if name in overrides else field.default
        values[name] = check(node.get_name(), field, value)
        descriptor = _descriptor(field)
        descriptor.read_only = on_change is None or not field.metadata['live']
        node.declare_parameter(name, values[name], descriptor, ignore_override=True)
    current = kind(**values)

    def change(parameters: list[Any]) -> SetParametersResult:
        nonlocal current
        try:
            new = _changed(node.get_name(), fields, current, parameters)
            if new != current and on_change is not None:
                on_change(new)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:
            # rclpy would end the process, and whoever asks would wait for ever.
            reason = str(fault_of_this_program(error))
            if isinstance(node, RemasterNode):
                node.on_fault(error)
            return SetParametersResult(successful=False, reason=reason)
        current = new
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(change)
    return current


def _changed(
    node_name: str,
    fields: Mapping[str, dataclasses.Field[Any]],
    current: T,
    parameters: Sequence[Any],
) -> T:
    """Return all parameters of a node, with new values of those that are set while it runs.

    ``fields``: of the dataclass, by name; ``current``: all parameters so far; ``parameters``:
    rclpy's, to be set. Raises InputError for a name that is unknown or not declared `live`, or
    a value that `check` refuses.
    """
    for item in parameters:
        if item.name not in fields or not fields[item.name].metadata['live']:
            raise InputError(
                f'{node_name}: {item.name} is read when the node starts; start it again with '
                'another value'
            )
    values = {item.name: check(node_name, fields[item.name], item.value) for item in parameters}
    return dataclasses.replace(current, **values)  # type: ignore[type-var]


def _descriptor(field: dataclasses.Field[Any]) -> ParameterDescriptor:
    """ROS descriptor of a parameter, with its description, unit, choices and range.

    A field may allow, besides its range, the single value `off` below it. The ROS range then
    reaches down to `off`, and `check` refuses the values in between.
    """
    meta = field.metadata
    unit = f' [{meta["unit"]}]' if meta['unit'] else ''
    descriptor = ParameterDescriptor(
        description=meta['description'] + unit,
        additional_constraints='one of ' + ', '.join(meta['choices']) if meta['choices'] else '',
    )
    low, high = meta['low'], meta['high']
    if meta['off'] is not None:
        # ROS has one range: the hole in it is looked at by `check`.
        descriptor.additional_constraints = f'{meta["off"]:g}, or at least {low:g}'
        low = min(low, meta['off'])
    if low is not None or high is not None:
        if isinstance(field.default, float):
            bounds = FloatingPointRange(
                from_value=-1e300 if low is None else float(low),
                to_value=1e300 if high is None else float(high),
            )
            descriptor.floating_point_range = [bounds]
        elif isinstance(field.default, int):
            limits = IntegerRange(
                from_value=-(2**62) if low is None else int(low),
                to_value=2**62 if high is None else int(high),
                step=1,
            )
            descriptor.integer_range = [limits]
    return descriptor

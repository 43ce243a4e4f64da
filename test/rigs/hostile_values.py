# SPDX-License-Identifier: Apache-2.0
"""Hostile values for every message, request and parameter, made from its fields alone.

Of a valid message one field at a time is spoilt: each message comes as deep as a valid one does.
"""

import array
import copy
import math

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rclpy.serialization import serialize_message
from std_msgs.msg import String

NUMBERS = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e-300, 2.0**31, -1.0, 0.0)
WHOLE = (2**31 - 1, -(2**31), 2**32 - 1, 2**63 - 1, 10**9, -1, 0)
LENGTHS = (0, 1, 3, 1000)
TEXTS = ('', 'x' * 2**20, 'no_such_joint', '\x00', '"{[', '1e999')


def spoilt(message, most=None, rng=None):
    """Return messages of which each differs from a valid one in one field, an empty one first.

    ``most``: so many of them, drawn with `rng`; all where None.
    """
    found = [type(message)()]
    for path in _paths(message):
        found += _with_values(message, path)
    if most is None or len(found) <= most:
        return found
    chosen = rng.choice(np.arange(1, len(found)), most - 1, replace=False)
    return [found[0], *(found[i] for i in sorted(chosen))]


def spoilt_text(text, most=None, rng=None):
    """Return std_msgs/String whose JSON has one number or word replaced, cut or repeated."""
    found = [*TEXTS, text[: len(text) // 2], text * 2, text.replace(':', ': ,', 1)]
    for at, character in enumerate(text):
        if character in ':[,' and at + 1 < len(text):
            end = next((i for i in range(at + 1, len(text)) if text[i] in ',]}'), len(text))
            for value in ('null', '1e300', '-1', '"x"', '[]', '{}', str(2**70), 'NaN'):
                found.append(text[: at + 1] + value + text[end:])
    if most is not None and len(found) > most:
        found = [found[i] for i in sorted(rng.choice(len(found), most, replace=False))]
    return [String(data=candidate) for candidate in found]


def spoilt_parameters(names):
    """Return a message for each parameter and value, of right and of wrong types."""
    kinds = ParameterType
    values = [
        *(
            ParameterValue(type=kinds.PARAMETER_DOUBLE, double_value=content)
            for content in NUMBERS
        ),
        *(
            ParameterValue(type=kinds.PARAMETER_INTEGER, integer_value=content)
            for content in WHOLE
            if abs(content) < 2**63
        ),
        *(ParameterValue(type=kinds.PARAMETER_STRING, string_value=content) for content in TEXTS),
        ParameterValue(type=kinds.PARAMETER_BOOL, bool_value=True),
        ParameterValue(type=kinds.PARAMETER_BYTE_ARRAY, byte_array_value=[b'x']),
        ParameterValue(type=kinds.PARAMETER_DOUBLE_ARRAY, double_array_value=[1.0, math.nan]),
        ParameterValue(type=kinds.PARAMETER_STRING_ARRAY, string_array_value=['a']),
        ParameterValue(type=kinds.PARAMETER_NOT_SET),
        ParameterValue(type=99),
    ]
    return [Parameter(name=name, value=value) for name in names for value in values]


def _paths(message, before=()):
    """Return the way to each field that holds no other message."""
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        if hasattr(value, 'get_fields_and_field_types'):
            yield from _paths(value, (*before, name))
        elif isinstance(value, list) and value and hasattr(value[0], '_fields_and_field_types'):
            yield (*before, name)
            # The first and the last of many.
            for index in {0, len(value) - 1}:
                yield from _paths(value[index], (*before, name, index))
        else:
            yield (*before, name)


def _at(message, path):
    for step in path:
        message = message[step] if isinstance(step, int) else getattr(message, step)
    return message


def _with_values(message, path):
    value = _at(message, path)
    if isinstance(value, bool):
        tried = [not value]
    elif isinstance(value, float):
        tried = NUMBERS
    elif isinstance(value, int):
        tried = WHOLE
    elif isinstance(value, str):
        tried = TEXTS
    elif isinstance(value, bytes):
        tried = [b'\x00', b'\xff']
    else:
        tried = list(_sequences(value))
    for replacement in tried:
        made = copy.deepcopy(message)
        try:
            setattr(_at(made, path[:-1]), path[-1], replacement)
        except (AssertionError, TypeError, OverflowError, ValueError):
            # No message has this value: rclpy's own checks.
            continue
        if _is_possible(made):
            yield made


def _is_possible(message):
    """Whether a message of these values can be on the network at all."""
    try:
        serialize_message(message)
    except (SystemError, AttributeError, TypeError, OverflowError):
        return False
    return True


def _sequences(value):
    items = list(value)
    if isinstance(value, np.ndarray):
        # Of fixed length.
        for item in NUMBERS:
            yield np.full(len(value), item)
        return
    for length in LENGTHS:
        yield (items * (length + 1))[:length] if items else []
    if isinstance(value, array.array) or (items and isinstance(items[0], float)):
        for item in NUMBERS:
            yield array.array('d', [item] * max(len(items), 1))
            yield array.array('d', [*items[:-1], item])
    elif items and isinstance(items[0], str):
        for item in TEXTS:
            yield [*items[:-1], item]
        yield [items[0]] * len(items)

# SPDX-License-Identifier: Apache-2.0
"""Ranges of the numbers in files, for the annotations of records.

They hold for every number of a field; `session.yaml_records` checks them::

    class Marker(msgspec.Struct, forbid_unknown_fields=True):
        position_m: Annotated[Triple, Bounds(-10.0, 10.0, 'm')]
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Bounds:
    """Allowed range of the numbers of a field in a file, which must be finite in any case."""

    least: float = -math.inf
    most: float = math.inf
    # For a value above `most` m, or below `least` degrees, the message also gives it converted
    # from millimetres or radians.
    unit: str = ''
    # Whether `least` is excluded.
    above: bool = False
    # Further text of the message.
    remedy: str = ''

    def problem(self, key: str, value: float) -> str:
        """Error message for an invalid value, a line with the remedy; '' if the value is valid.

        ``key``: name of the value in that line. NaN and infinite values are invalid.
        """
        if not math.isfinite(value):
            return f'{key}: {value} is not a finite number; correct it'
        if self.least < value <= self.most or (value == self.least and not self.above):
            return ''
        limits = [f'above {self.least:g}' if self.above else f'from {self.least:g}']
        if math.isfinite(self.most):
            limits.append(f'to {self.most:g}')
        text = f'{key} is {value:g}; it must be {" ".join((*limits, self.unit)).rstrip()}'
        if self.unit == 'm' and abs(value) > self.most:
            text += f'; if millimetres were meant, write {value / 1e3:g}'
        elif self.unit == 'degrees' and 0.0 < value < self.least:
            text += f'; if radians were meant, write {math.degrees(value):.4g}'
        return text + self.remedy

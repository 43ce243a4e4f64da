# SPDX-License-Identifier: Apache-2.0
"""Held-out configurations that were fitted as well, and so are no test of others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from remaster_ros.types import Measurements

# Joint angles that differ by less are those of one configuration, approached twice, rad.
SAME_RAD = float(np.radians(0.05))


@dataclass(frozen=True)
class MeasuredAgain:
    """Number of held-out configurations, and of those that were fitted as well."""

    again: int
    held_out: int

    @classmethod
    def of(cls, measurements: Measurements) -> MeasuredAgain:
        """Number of held-out configurations, and of those of them that were fitted as well.

        A configuration counts as fitted as well if all its joints are within 0.05 degrees
        (`SAME_RAD`; for a slide that number in m) of a fitted one; none does if all rows are held
        out.
        """
        first = np.unique(measurements.configuration, return_index=True)[1]
        q, held_out = measurements.q[first], measurements.is_validation[first]
        if not held_out.any() or held_out.all():
            return cls(0, int(held_out.sum()))
        distances = scipy.spatial.cKDTree(q[~held_out]).query(q[held_out], p=np.inf)[0]
        return cls(int(np.sum(distances < SAME_RAD)), int(held_out.sum()))

    @property
    def most(self) -> bool:
        """Whether more than half of the held-out configurations were fitted as well."""
        return self.again > 0.5 * self.held_out

    @property
    def words(self) -> str:
        """Sentence for the report; '' if no held-out configuration was fitted as well.

        It asks for other configurations if more than half were.
        """
        if not self.again:
            return ''
        return (
            f'{self.again} of {self.held_out} held-out configurations '
            f'{"was" if self.again == 1 else "were"} fitted as well (joint angles within '
            f'{np.degrees(SAME_RAD):.2g} degrees): that proves nothing of others'
            + ('; measure others and fit again.' if self.most else '.')
        )

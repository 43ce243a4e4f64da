# SPDX-License-Identifier: Apache-2.0
"""Facts of a collection's plan for a report: the plan, its outcome, the precision reached."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from msgspec import UNSET

from remaster_ros.errors import InputError
from remaster_ros.reports.report_inputs import Inputs
from remaster_ros.session.files import write_atomically

if TYPE_CHECKING:
    from remaster_ros.session.records.plan_journal import RecordedPlan

PLAN_FILE = 'plan.html'
RECORDED = ('recorded', 'partial')
NOT_VISITED = 'not visited'
AS_EXPECTED = 1.5
"""Largest factor between expected and reached standard deviations, in the median, that counts as
agreement."""


class PlannedRow(NamedTuple):
    """Numbers of planned and recorded configurations of a split, and of lost ones by reason."""

    words: str
    poses: int
    planned: int
    recorded: int
    lost: dict[str, int]


class StdRow(NamedTuple):
    """Standard deviation of a joint's offset: expected, and of the fit; None if unknown."""

    joint: str
    unit: Literal['deg', 'mm']
    expected: float | None
    fit: float | None


@dataclass(frozen=True)
class PlanFacts:
    """Facts of a collection's plan for a report: counts, losses, time, and precision reached."""

    name: str  # Fingerprint of the plan
    rows: tuple[PlannedRow, ...]  # One for each split
    visits: int  # Number of recorded visits to references
    minutes: float | None  # From the first reading to the last; None if times are unknown
    # Reason -> poses and configurations that were never in the plan
    dropped: dict[str, tuple[int, int]]
    stds: tuple[StdRow, ...]  # One for each joint; empty if none were expected
    # Median ratio of the fit's standard deviations to the expected ones; None if unknown
    ratio: float | None
    tool_mm: float | None  # Expected RMS error of the predicted markers; None if unknown
    enough: bool  # Whether poses were left out because the precision sufficed
    drawn: bool  # Whether there is a page that plays the plan

    @property
    def verdict(self) -> str:
        """Sentence comparing the standard deviations reached with those expected; '' if unknown.

        Within a factor of 1.5 (`AS_EXPECTED`) they agree.
        """
        if self.ratio is None:
            return ''
        if self.ratio < 1.0 / AS_EXPECTED:
            return (
                f'The fit states the offsets {1.0 / self.ratio:.1f} times better than was '
                'expected: the readings scatter less than noise_m and pose_noise_m of the cell '
                'file state.'
            )
        if self.ratio <= AS_EXPECTED:
            return 'The fit states the offsets about as well as was expected.'
        return (
            f'The fit states the offsets {self.ratio:.1f} times less well than was expected: the '
            'readings scatter more than noise_m and pose_noise_m of the cell file state, or '
            'configurations were lost.'
        )


def plan_facts(inputs: Inputs) -> PlanFacts | None:
    """Return the facts of the session's plan for the page; None if it has none.

    Numbers by split, reasons of dropped poses, minutes that it took (None without times),
    expected and reached standard deviations and their median ratio.
    """
    plan, session = inputs.plan, inputs.session
    if plan is None:
        return None
    # What plans is imported where there is a plan.
    from remaster_ros.collection.plan_confirmation import fingerprint
    from remaster_ros.reports.plan_page import WORDS

    splits = [split for split in WORDS if split in plan.tour.configurations]
    stds = _stds(inputs, plan)
    ratios = [row.fit / row.expected for row in stds if row.fit and row.expected]
    stamps = [session.measurements.stamp_s]
    stamps += [] if session.references is None else [session.references.stamp_s]
    tour = plan.tour
    return PlanFacts(
        fingerprint(tour),
        tuple(_row(plan, split, WORDS[split][0]) for split in splits),
        sum(plan.references[result] for result in RECORDED),
        float(np.ptp(np.concatenate(stamps))) / 60.0 if session.timed else None,
        {
            reason: (tour.dropped[reason], tour.dropped_solutions[reason])
            for reason in (tour.dropped_solutions + tour.dropped)
        },
        stds,
        float(np.median(ratios)) if ratios else None,
        1e3 * plan.expected.tool_rms_m if plan.expected is not None else None,
        plan.enough,
        bool(drawn_plan(plan)),
    )


def _row(plan: RecordedPlan, split: str, words: str) -> PlannedRow:
    """Planned and recorded configurations of a split, and those lost, by reason.

    ``words``: name of the split on the page. Those without an outcome count as not visited.
    """
    poses = plan.tour.plans[split].poses
    ends = Counter(
        result for (row_split, *_), result in plan.outcomes.items() if row_split == split
    )
    recorded = sum(ends.pop(result, 0) for result in RECORDED)
    planned = plan.tour.configurations[split]
    missing = planned - recorded - ends.total()
    lost = {result.replace('_', ' '): count for result, count in ends.most_common()}
    lost |= {NOT_VISITED: missing} if missing > 0 else {}
    return PlannedRow(words, len(poses), planned, recorded, lost)


def _stds(inputs: Inputs, plan: RecordedPlan) -> tuple[StdRow, ...]:
    """Return the expected and the fit's standard deviation of each joint's offset, deg or mm.

    The fit's is that for an arm exactly as drawn, without errors that remain beyond noise, as the
    expected one is; None if the offset is not identifiable. () if none were expected.
    """
    if plan.expected is None:
        return ()
    expected = plan.expected.joint_std_rad
    rows = []
    for row in inputs.fit.joint_offsets:
        # Of the model and the drawing, as what is expected: of errors left, and of an arm that is
        # off its drawing, it is wider.
        keys = ('model_std', 'std_if_exactly_drawn', 'std')
        stds = [getattr(row, f'{key}_{row.unit}') for key in keys]
        std = next(value for value in stds if value is not UNSET)
        before = expected.get(row.joint)
        scale = 1e3 if row.unit == 'mm' else float(np.degrees(1.0))
        shown = None if before is None else scale * before
        rows.append(StdRow(row.joint, row.unit, shown, std if row.identifiable else None))
    return tuple(rows)


def drawn_plan(plan: RecordedPlan) -> bytes:
    """Return the page that plays the plan, if the planner left one with the session; else b''."""
    from remaster_ros.collection.plan_confirmation import fingerprint
    from remaster_ros.reports.plan_page import read_plan_page

    try:
        return read_plan_page(plan.page, fingerprint(plan.tour))
    except InputError:
        return b''


def copy_plan(plan: RecordedPlan | None, folder: Path) -> None:
    """Copy the page of the plan to a folder, so that the report is complete.

    An earlier copy is removed, also if there is no plan.
    """
    (folder / PLAN_FILE).unlink(missing_ok=True)
    if plan is not None and (html := drawn_plan(plan)):
        write_atomically(folder / PLAN_FILE, html)


def plan_to_dict(plan: PlanFacts) -> dict[str, Any]:
    """Return the facts of a plan as ``remaster report --json`` has them."""
    return {
        'name': plan.name,
        'splits': [row._asdict() for row in plan.rows],
        'reference_visits': plan.visits,
        'minutes': plan.minutes,
        'dropped': {reason: counts[0] for reason, counts in plan.dropped.items()},
        'dropped_configurations': {reason: counts[1] for reason, counts in plan.dropped.items()},
        **{
            f'std_{unit}': {
                row.joint: {'expected': row.expected, 'fit': row.fit}
                for row in plan.stds
                if row.unit == unit
            }
            for unit in ('deg', 'mm')
            if unit == 'deg' or any(row.unit == unit for row in plan.stds)
        },
    }

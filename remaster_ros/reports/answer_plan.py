"""The plan on the page of `remaster report`: what was planned, what became of it, what it gave."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET

from remaster_ros.collection.plan_confirmation import fingerprint
from remaster_ros.errors import InputError
from remaster_ros.reports.answer_inputs import Inputs
from remaster_ros.reports.plan_page import WORDS, read_plan_page
from remaster_ros.session.files import write_atomically
from remaster_ros.session.plan_journal import RecordedPlan

PLAN_FILE = 'plan.html'
RECORDED = ('recorded', 'partial')
NOT_VISITED = 'not visited'
AS_EXPECTED = 1.5
"""Standard deviations that are, in the middle, no more than so many times larger or smaller than
the expected ones are as expected."""


class PlannedRow(NamedTuple):
    """A split: what was planned, and what became of it."""

    words: str
    poses: int
    planned: int
    recorded: int
    lost: dict[str, int]


class StdRow(NamedTuple):
    """Standard deviation of a joint's offset, degrees: expected, and of the fit; None for none."""

    joint: str
    expected: float | None
    fit: float | None


@dataclass(frozen=True)
class PlanFacts:
    """What the page has of a plan.

    Attributes
    ----------
    name
        Its fingerprint.
    rows
        Of each split.
    visits
        Visits to references that were recorded.
    minutes
        From the first reading to the last; None where times are not known.
    dropped
        Reason -> poses and configurations that were never in the plan.
    stds
        Of each joint; empty where nothing was noted.
    ratio
        Median of the fit's standard deviations over the expected ones; None where there are none.
    tool_mm
        Expected error of the predicted markers (RMS); None.
    enough
        Whether poses were left out as enough was known.
    drawn
        Whether there is a page that plays it.
    """

    name: str
    rows: tuple[PlannedRow, ...]
    visits: int
    minutes: float | None
    dropped: dict[str, tuple[int, int]]
    stds: tuple[StdRow, ...]
    ratio: float | None
    tool_mm: float | None
    enough: bool
    drawn: bool

    @property
    def verdict(self) -> str:
        """What the standard deviations tell of the readings; '' where nothing is known."""
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
    """Return what the page has of the session's plan; None where it has none."""
    plan, session = inputs.plan, inputs.session
    if plan is None:
        return None
    splits = [split for split in WORDS if split in plan.tour.configurations]
    stds = _stds(inputs, plan)
    ratios = [row.fit / row.expected for row in stds if row.fit and row.expected]
    stamps = [session.measurements.stamp_s]
    stamps += [] if session.references is None else [session.references.stamp_s]
    tour = plan.tour
    return PlanFacts(
        fingerprint(tour),
        tuple(_row(plan, split) for split in splits),
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


def _row(plan: RecordedPlan, split: str) -> PlannedRow:
    poses = plan.tour.plans[split].poses
    ends = Counter(result for (own, *_), result in plan.outcomes.items() if own == split)
    recorded = sum(ends.pop(result, 0) for result in RECORDED)
    planned = plan.tour.configurations[split]
    left = planned - recorded - ends.total()
    lost = {result.replace('_', ' '): count for result, count in ends.most_common()}
    lost |= {NOT_VISITED: left} if left > 0 else {}
    return PlannedRow(WORDS[split][0], len(poses), planned, recorded, lost)


def _stds(inputs: Inputs, plan: RecordedPlan) -> tuple[StdRow, ...]:
    if plan.expected is None:
        return ()
    expected = plan.expected.joint_std_rad
    rows = []
    for row in inputs.fit.joint_offsets:
        # Of the model alone, as what is expected: where other errors are left it is wider.
        std = row.std_deg if row.model_std_deg is UNSET else row.model_std_deg
        before = expected.get(row.joint)
        degrees = None if before is None else float(np.degrees(before))
        rows.append(StdRow(row.joint, degrees, std if row.identifiable else None))
    return tuple(rows)


def drawn_plan(plan: RecordedPlan) -> bytes:
    """Return the page that plays the plan, where the planner has left one beside the session."""
    try:
        return read_plan_page(plan.page, fingerprint(plan.tour))
    except InputError:
        return b''


def copy_plan(plan: RecordedPlan | None, folder: Path) -> None:
    """Copy the page of the plan, so that this one can be handed on with it."""
    (folder / PLAN_FILE).unlink(missing_ok=True)
    if plan is not None and (html := drawn_plan(plan)):
        write_atomically(folder / PLAN_FILE, html)


def plan_to_dict(plan: PlanFacts) -> dict[str, Any]:
    """Return what ``remaster report --json`` prints of it."""
    return {
        'name': plan.name,
        'splits': [row._asdict() for row in plan.rows],
        'reference_visits': plan.visits,
        'minutes': plan.minutes,
        'dropped': {reason: counts[0] for reason, counts in plan.dropped.items()},
        'dropped_configurations': {reason: counts[1] for reason, counts in plan.dropped.items()},
        'std_deg': {row.joint: {'expected': row.expected, 'fit': row.fit} for row in plan.stds},
    }

"""The plan of a session as it was, and what became of it, from plan.jsonl; nothing is locked."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.collection_plan import FITTED
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION, Tour
from remaster_ros.session.journal import read_journal
from remaster_ros.session.plain_data import from_plain
from remaster_ros.session.plan_records import (
    NO_FREE_PATH,
    EnoughNoted,
    ExpectationNoted,
    OutcomeNoted,
    PlanRecord,
    RouteNoted,
    StopNoted,
    TourNoted,
)
from remaster_ros.session.session_opening import PLAN


def plan_page_path(session: Path) -> Path:
    """Return where the plan of a session is drawn for a person: beside its folder."""
    return session.absolute().with_name(f'{session.absolute().name}.plan.html')


Configuration = tuple[str, int, int]
"""Split, pose and solution, as in the plan."""


@dataclass
class RecordedPlan:
    """A planned collection and its end.

    Attributes
    ----------
    tour
        As planned.
    page
        Where the planner draws it where a person has to confirm it (`confirm: true`).
    expected
        What its fit was expected to state; None in sessions of older versions.
    outcomes
        What became of each configuration that was begun, references not among them: ``recorded``,
        ``partial``, ``rejected``, ``failed`` or ``no_free_path``.
    references
        How many visits to references came to which end.
    enough
        Whether poses to fit were left out because enough was known.
    """

    tour: Tour
    page: Path
    expected: ExpectationNoted | None = None
    outcomes: dict[Configuration, str] = field(default_factory=dict)
    references: Counter[str] = field(default_factory=Counter)
    enough: bool = False


def read_plan(folder: Path, chain: SerialChain) -> RecordedPlan | None:
    """Return the plan of a session's collection; None where it has none.

    Parameters
    ----------
    folder
        The session's.
    chain
        Its arm.

    Raises
    ------
    InputError
        plan.jsonl is damaged, or no plan of this version.
    """
    path = folder / PLAN
    if not path.exists():
        return None
    plan: RecordedPlan | None = None
    split, index = '', 0
    try:
        for record in from_plain(read_journal(path).records, list[PlanRecord]):
            match record:
                case TourNoted():
                    collection = REGISTRATION not in record.plans
                    tour = record.tour(chain)
                    plan = RecordedPlan(tour, plan_page_path(folder)) if collection else None
                case StopNoted():
                    split, index = record.split, record.index
            if plan is None:
                continue
            match record:
                case ExpectationNoted():
                    plan.expected = record
                case RouteNoted():
                    _close(plan, split, index, record.unreached, NO_FREE_PATH)
                case OutcomeNoted():
                    _close(plan, split, index, (record.id,), record.result)
                case EnoughNoted():
                    plan.enough = True
        return plan if plan is not None and plan.tour.plans[FITTED].poses else None
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(
            f'{path}: no plan of this version ({type(error).__name__}: {error}); '
            'move it out of the session folder to go without'
        ) from None


def _close(
    plan: RecordedPlan, split: str, index: int, solutions: tuple[int, ...], result: str
) -> None:
    """Note what became of configurations; a first outcome stays."""
    for solution in solutions:
        if split == REFERENCE:
            plan.references[result] += 1
        else:
            plan.outcomes.setdefault((split, index, solution), result)

"""The records of plan.jsonl, one a line; see `session.plan_journal`, which writes them."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import Plan
from remaster_ros.planning.tour_order import Route, Tour
from remaster_ros.types import FloatArray

NO_FREE_PATH = 'no_free_path'
"""Outcome of a configuration that the arm cannot get to without hitting something."""


class PlanBegun(msgspec.Struct, tag_field='kind', tag='plan'):
    """The first record: the plan's name, and what it depends on."""

    id: str
    settings: dict[str, Any]


class TourNoted(msgspec.Struct, tag_field='kind', tag='tour'):
    """A tour, as planned."""

    plans: dict[str, Plan]
    in_order: bool
    one_solution: bool
    # Plans of older versions have no references, and go on without them.
    reference_every: int = 0
    # Empty where the nearest pose is next.
    order: tuple[tuple[str, int, int], ...] = ()
    # Above 0 behind another tour of the collection.
    begin_at: int = 0

    def tour(self, chain: SerialChain, model: CollisionModel | None = None) -> Tour:
        """Return the tour of this arm, at its beginning; the model is what it must not hit."""
        return Tour(
            chain,
            self.plans,
            in_order=self.in_order,
            one_solution=self.one_solution,
            model=model,
            reference_every=self.reference_every,
            order=self.order,
            begin_at=self.begin_at,
        )


class RouteNoted(msgspec.Struct, tag_field='kind', tag='route'):
    """Solutions in the order of their visits, by number; `paths` has those that go around."""

    ids: tuple[int, ...]
    paths: dict[str, FloatArray] = {}
    unreached: tuple[int, ...] = ()

    def route(self, joints: int) -> Route:
        """Return it as a tour has it, for an arm with so many joints."""
        straight = np.empty((0, joints))
        paths = tuple(self.paths.get(str(number), straight) for number in self.ids)
        return Route(self.ids, paths, self.unreached)


class StopNoted(RouteNoted, kw_only=True, tag='stop'):
    """The next pose: which of the poses of its split, and the way to its solutions."""

    split: str
    index: int


class RoundNoted(msgspec.Struct, tag_field='kind', tag='round'):
    """A round of the references is next, by request."""


class EnoughNoted(msgspec.Struct, tag_field='kind', tag='enough'):
    """Enough is known: no more poses to fit are visited."""


class ExpectationNoted(msgspec.Struct, tag_field='kind', tag='expected'):
    """What a fit of the tour before it is expected to state, at the noise of the cell file."""

    joint_std_rad: dict[str, float | None]
    tool_rms_m: float


class OutcomeNoted(msgspec.Struct, tag_field='kind', tag='outcome'):
    """What became of a solution of the last pose."""

    id: int
    result: str


class StateNoted(msgspec.Struct, tag_field='kind', tag='state'):
    """The planner's state, and the token of the run that it is in."""

    state: str
    run: str = ''


PlanRecord = (
    PlanBegun
    | TourNoted
    | RouteNoted
    | StopNoted
    | RoundNoted
    | EnoughNoted
    | ExpectationNoted
    | OutcomeNoted
    | StateNoted
)

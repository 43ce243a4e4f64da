# SPDX-License-Identifier: Apache-2.0
"""Whether a person has looked at the plan that the arm is about to follow.

What counts is the plan itself, by its fingerprint, not that something was confirmed: the tour for
the registration, that of the collection, and a tour that was planned anew are different plans.
Nothing of it is written down: a planner that is started again has no confirmation.
"""

from __future__ import annotations

import hashlib

import numpy as np

from remaster_ros.planning.tour_order import Tour

CONFIRM, COLLECT = '/remaster/confirm', '/remaster/collect'


def fingerprint(tour: Tour) -> str:
    """Return a short name of a tour: equal poses, solutions and order have the same."""
    found = hashlib.sha256(repr((tour.order, tour.reference_every)).encode())
    for split, plan in sorted(tour.plans.items()):
        found.update(f'{split} {len(plan.poses)} '.encode())
        for pose in plan.poses:
            found.update(f'{pose.solutions.shape} {pose.correction}'.encode())
            found.update(np.ascontiguousarray(pose.solutions).tobytes())
    return found.hexdigest()[:8]


def service_name(plan: str) -> str:
    """Return the name below /remaster/confirm of the service that confirms this plan alone."""
    return f'plan_{plan}'


class PlanConfirmation:
    """Which plan is shown, and which was confirmed.

    Parameters
    ----------
    required
        Whether the arm waits for a confirmation; without, every plan may be followed.
    page
        Where plans are shown, for messages.

    Attributes
    ----------
    required
        As given.
    shown
        Fingerprint of the plan on the page; '' while there is none.
    confirmed
        Of the plan that was confirmed; '' for none.
    trouble
        Why the next plan cannot be shown; ''.
    """

    def __init__(self, required: bool, page: str) -> None:
        self.required, self._page = required, page
        self.shown = self.confirmed = self.trouble = ''
        # Shown and never confirmed: a person may be looking at one of them still.
        self._pending: set[str] = set()

    def withdraw(self) -> None:
        """Take it that the page is out of date: another plan is to be shown."""
        self.shown = self.trouble = ''

    def show(self, plan: str) -> None:
        """Take it that the page shows this plan."""
        self.shown, self.trouble = plan, ''
        if plan != self.confirmed:
            self._pending.add(plan)

    def allows(self, tour: Tour | None) -> bool:
        """Whether the arm may follow a tour."""
        if not self.required:
            return True
        return tour is not None and self.confirmed == fingerprint(tour)

    def refusal(self) -> str:
        """Return why the arm may not move, with what to do about it; ''."""
        if not self.required:
            return ''
        if self.trouble:
            return f'the plan cannot be shown: {self.trouble}'
        if not self.shown:
            return (
                f'the plan is not confirmed; it is being drawn: look at {self._page} when it is '
                f'there, then call {CONFIRM} and {COLLECT}'
            )
        if self.shown != self.confirmed:
            return (
                f'plan {self.shown} is not confirmed: look at {self._page}, then call {CONFIRM} '
                f'and {COLLECT}'
            )
        return ''

    def confirm(self, plan: str = '') -> tuple[bool, str]:
        """Confirm the plan that is shown; return whether there is one, and the answer.

        Parameters
        ----------
        plan
            Which one the person has seen: no other is confirmed, however late the request comes.
            '' for the one that is shown, which is refused where it has taken the place of another.
        """
        if not self.required:
            return False, 'no plan waits for that; confirm: true in the cell file asks for it'
        if plan and plan != self.shown:
            return False, f'plan {plan} is not the one that is next; {self.refusal()}'.rstrip('; ')
        if not self.shown:
            return False, self.refusal()
        if not plan and self._pending - {self.shown}:
            return False, (
                f'plan {self.shown} has taken the place of another one: look at {self._page} '
                f'again, then call {CONFIRM}/{service_name(self.shown)} and {COLLECT}'
            )
        self.confirmed = self.shown
        self._pending.clear()
        return True, f'plan {self.shown} is confirmed; {COLLECT} begins or goes on'
